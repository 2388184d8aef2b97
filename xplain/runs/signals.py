"""A sweep ends cleanly on a signal, and its workers end with it."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import cache


@contextmanager
def interruptible() -> Iterator[threading.Event]:
    """SIGTERM and a closed terminal end the sweep like Ctrl-C, so that MLflow hears of it; the
    event tells that one of them came."""
    came = threading.Event()

    def interrupt(*_: object) -> None:
        came.set()
        raise KeyboardInterrupt

    numbers = []
    if threading.current_thread() is threading.main_thread():  # else someone embeds this
        numbers = [signal.SIGTERM, signal.SIGINT, signal.SIGHUP]
    # A shell's background job ignores Ctrl-C, and shall; nohup a closed terminal.
    heard = [number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, interrupt) for number in heard}
    try:
        with _not_for_workers() if signal.SIGINT in heard else nullcontext():
            yield came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _not_for_workers() -> Iterator[None]:
    """Ctrl-C reaches every process of the terminal, and a worker that imports would print
    tracebacks. Workers inherit that it is blocked; here a thread waits for it."""
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # its start lifts the block
    ended = threading.Event()

    def wait() -> None:
        signal.sigwait({signal.SIGINT})
        if not ended.is_set():
            os.kill(os.getpid(), signal.SIGTERM)

    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    waiting = threading.Thread(target=wait, daemon=True)
    waiting.start()
    try:
        yield
    finally:
        ended.set()
        if waiting.is_alive():
            signal.pthread_kill(waiting.ident or 0, signal.SIGINT)
        waiting.join()
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


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
