"""The training of a study: every run a process of its own, which goes on where it stopped; what it took is kept.

Runs are started by the command line (`agentspec train`), with the configurations that lie in the study's folder
`configs`. A run whose records are sealed has ended and is not started again.
"""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from agentspec.files import append_lines
from eval.study.plan import Study


def train_all(study: Study, jobs: int) -> None:
    """The warm start, then every training run that has not ended, `jobs` at a time.

    Raises:
        SystemExit: one failed; those that are under way go on to their ends.
    """
    if study.start and not (study.start / "manifest.json").is_file():  # it is written last
        process(study, "warm start", "sft_warmup", "warmup", study.start)

    def one(run: tuple[str, int]) -> None:
        arm, seed = run
        process(study, f"train {arm}", study.arms[arm].recipe, arm, study.folder(*run), "--seed", str(seed), *RESUME)

    with ThreadPoolExecutor(jobs) as pool:
        started = [pool.submit(one, run) for run in study.runs if run not in study.ended]
        try:
            for run in started:
                run.result()
        finally:
            pool.shutdown(cancel_futures=True)


RESUME = ("--resume", "true")


def process(study: Study, what: str, recipe: str, config: str, folder: Path, *more: str) -> None:
    """One recipe in a process of its own; what it took is a line of `costs.jsonl`.

    Raises:
        SystemExit: it failed.
    """
    file = Path(study.out) / "configs" / f"{config}.yaml"
    command = [sys.executable, "-m", "agentspec.cli", "train", recipe, "--config", str(file)]
    command += ["--output_dir", str(folder), *more]
    print(f"{what}: {' '.join(command)}", file=sys.stderr, flush=True)
    started = subprocess.Popen(command, env={"OMP_NUM_THREADS": "1", **os.environ})
    _, status, usage = os.wait4(started.pid, 0)
    started.returncode = os.waitstatus_to_exitcode(status)
    if started.returncode:
        raise SystemExit(f"{folder}: failed (see above); the same command goes on from its last checkpoint")
    spent = {"what": what, "run": folder.name, "cpu_s": round(usage.ru_utime + usage.ru_stime, 1)}
    append_lines(Path(study.out) / "costs.jsonl", spent)
