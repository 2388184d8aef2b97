"""What a worker of joblib does beyond its jobs: it ends when the sweep was killed."""

from __future__ import annotations

import multiprocessing
import os
import threading
import time
from functools import cache


@cache
def end_with_parent() -> None:
    """Watches the process that started this worker, once a worker.

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
