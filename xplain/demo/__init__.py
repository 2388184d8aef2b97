"""One explanation, played and written as a page: ``xplain demo``."""
