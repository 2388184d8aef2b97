"""Ends a command's sweep and its workers cleanly on a signal."""

import multiprocessing
import os
import signal
import threading
import time
from functools import cache
from multiprocessing import resource_tracker
from typing import NoReturn

CAME = threading.Event()
"""Is set when a signal interrupts this process. A library may replace the interruption by another
error, but not this event."""


def end_on_signals() -> None:
    """Makes SIGTERM and a closed terminal interrupt this process like Ctrl-C. Workers ignore
    Ctrl-C, because an interrupted import would print a traceback."""

    def interrupt(*_: object) -> NoReturn:
        CAME.set()
        raise KeyboardInterrupt

    def wait() -> None:
        while signal.sigwait({signal.SIGINT}):
            os.kill(os.getpid(), signal.SIGTERM)

    # Ignored signals stay ignored: Ctrl-C in a background job, a closed terminal under nohup.
    numbers = (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)
    heard = [number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN]
    for number in heard:
        signal.signal(number, interrupt)
    if signal.SIGINT in heard:
        resource_tracker.ensure_running()  # a later start would remove the block
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # workers inherit this
        threading.Thread(target=wait, daemon=True).start()


@cache
def end_with_parent() -> None:
    """Ends this joblib worker when the process that started it ends. Call it once in a worker.

    Otherwise the workers of a sweep that was killed with ``kill -9`` continue beside the workers of
    the restarted sweep, and then wait for minutes. Workers on clusters are ended by their
    scheduler.
    """
    if not multiprocessing.current_process().name.startswith("LokyProcess"):
        return
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
