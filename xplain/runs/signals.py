"""A command's sweep ends cleanly on a signal, and its workers end with it."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from functools import cache
from multiprocessing import resource_tracker
from typing import NoReturn

CAME = threading.Event()
"""Set by a signal that ends the process: a library may make another error of the interruption."""


def end_on_signals() -> None:
    """From here on SIGTERM and a closed terminal interrupt this process as Ctrl-C does, and Ctrl-C
    reaches no worker: one that imports would print a traceback."""

    def interrupt(*_: object) -> NoReturn:
        CAME.set()
        raise KeyboardInterrupt

    def wait() -> None:
        while signal.sigwait({signal.SIGINT}):
            os.kill(os.getpid(), signal.SIGTERM)

    # A shell's background job ignores Ctrl-C, and shall; nohup a closed terminal.
    numbers = (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)
    heard = [number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN]
    for number in heard:
        signal.signal(number, interrupt)
    if signal.SIGINT in heard:
        resource_tracker.ensure_running()  # its start would lift the block
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # which workers inherit
        threading.Thread(target=wait, daemon=True).start()


@cache
def end_with_parent() -> None:
    """Watches the process that started this worker of joblib, once a worker, and ends with it.

    Without it the worker of a sweep killed with -9 works on, beside the rerun's workers, and
    idles for minutes. Workers of clusters have keepers of their own.
    """
    if not multiprocessing.current_process().name.startswith("LokyProcess"):
        return
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
