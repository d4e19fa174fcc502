"""What benchmarks measure with: seconds, memory, and what the machine can do at best.

Ceilings are measured in the run that they are compared with, by the same clock: `least / measured` is how much of the
machine was used, whatever machine it is.
"""

from __future__ import annotations

import resource
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch  # benchmarks without a model need none


class PeakMemory:
    """Largest growth of memory inside a `with` block, in MiB: CUDA's own counter, or the resident set every 5 ms."""

    def __init__(self, cuda: bool = False) -> None:
        self._cuda = cuda

    def __enter__(self) -> PeakMemory:
        self.peak_mb = 0.0
        if self._cuda:
            import torch

            torch.cuda.reset_peak_memory_stats()
            self._start = torch.cuda.memory_allocated() / 2**20
            return self
        self._start, self._stop = rss_mb(), threading.Event()
        self._thread = threading.Thread(target=self._poll, daemon=True)
        self._thread.start()
        return self

    def _poll(self) -> None:
        while not self._stop.wait(0.005):
            self.peak_mb = max(self.peak_mb, rss_mb() - self._start)

    def __exit__(self, *_: object) -> None:
        if self._cuda:
            import torch

            self.peak_mb = torch.cuda.max_memory_allocated() / 2**20 - self._start
            return
        self._stop.set()
        self._thread.join()
        self.peak_mb = max(self.peak_mb, rss_mb() - self._start)


def rss_mb() -> float:
    """Resident memory of this process in MiB."""
    if sys.platform != "linux":
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * resource.getpagesize() / 2**20


def clock(device: torch.device) -> float:
    """Seconds of processor time, per thread; on an accelerator by the wall, when what was asked of it is done."""
    import torch

    if device.type != "cpu":
        torch.accelerator.synchronize()
        return time.perf_counter()
    return time.process_time() / torch.get_num_threads()


@dataclass(frozen=True)
class Ceilings:
    """`flops` of a large product of matrices per second; bytes per second of a copy, `copied` (read and written), and
    of a sum, `read`.
    """

    flops: float
    copied: float
    read: float


def ceilings(device: torch.device) -> Ceilings:
    """The best of five of each, in float32, by `clock`.

    A product is the faster of torch's own and, on a CPU, oneDNN's with packed weights; the sum is over 512 MB, about
    the size of the smallest model's weights and of more than most caches hold.
    """
    import torch

    from agentspec.llm.local.invariance import packs

    a, b = torch.randn(2048, 576, device=device), torch.randn(1536, 576, device=device)
    x, out = torch.ones(1 << 27, device=device), torch.empty(1 << 24, device=device)
    products: list[Callable[[], object]] = [lambda: torch.nn.functional.linear(a, b)]
    if device.type == "cpu" and packs():
        packed = torch.ops.mkldnn._reorder_linear_weight(b)
        products.append(lambda: torch.ops.mkldnn._linear_pointwise(a, packed, None, "none", [], ""))

    def best(run: Callable[[], object]) -> float:
        seconds = []
        for _ in range(5):
            start = clock(device)
            run()
            seconds.append(clock(device) - start)
        return min(seconds)

    product = min(map(best, products))
    copy, total = best(lambda: out.copy_(x[: 1 << 24])), best(x.sum)
    return Ceilings(2 * a.shape[0] * a.shape[1] * b.shape[0] / product, 8 * out.numel() / copy, 4 * x.numel() / total)
