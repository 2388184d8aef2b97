"""``python -m xplain``, the same as the console script ``xplain``."""

import signal

if __name__ == "__main__":
    # Ctrl-C while modules are loaded ends the process without a traceback.
    before = signal.signal(signal.SIGINT, signal.SIG_DFL)
    from xplain.cli.main import main

    signal.signal(signal.SIGINT, before)
    main()
