"""One explanation, played: ``python -m xplain demo`` (terminal), ``--html FILE`` (a page)."""
