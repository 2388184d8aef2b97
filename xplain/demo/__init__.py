"""One explanation, played: ``xplain demo`` (terminal), ``--html FILE`` (a page), ``--serve``."""
