"""``python -m xplain``, the same as the console script ``xplain``."""

from xplain.cli.main import main

if __name__ == "__main__":
    main()
