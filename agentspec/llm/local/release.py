"""Give freed memory back to the system."""

from __future__ import annotations

import ctypes
import gc
import sys


def release() -> None:
    """Collect what nobody holds, and return free pages; glibc keeps those of large tensors for later otherwise."""
    gc.collect()
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "malloc_trim"):
        libc.malloc_trim(0)
