"""One explanation, played: ``xplain demo`` writes a page, ``--serve`` opens a playground."""
