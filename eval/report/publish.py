"""A report in Weights & Biases or TensorBoard: its tables and figures, and the whole of it as an artifact.

Nothing is sent unless the user's own settings send it: `WANDB_MODE=offline` keeps a run on disk.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from agentspec.registry import SpecError
from eval.report.blocks import Figure, Heading, Table
from eval.report.build import Report

TRACKERS = ("wandb", "tensorboard")


def publish(report: Report, folder: str | Path, tracker: str, *, project: str = "agentspec") -> str:
    """Log a report that was written into `folder`.

    Returns:
        where it is.

    Raises:
        SpecError: an unknown tracker, or one that is not installed.
    """
    if tracker == "wandb":
        return _wandb(report, Path(folder), project)
    if tracker == "tensorboard":
        return _tensorboard(report, Path(folder))
    raise SpecError(f"unknown tracker {tracker!r}; expected one of {', '.join(TRACKERS)}")


def _wandb(report: Report, folder: Path, project: str) -> str:
    try:
        import wandb
    except ImportError:
        raise SpecError("--publish wandb needs it: pip install 'agentspec-rl[wandb]'") from None
    run = wandb.init(project=project, job_type="report", name=report.title, dir=str(folder))
    logged: dict[str, Any] = {}
    for name, block in named(report):
        if isinstance(block, Table):
            columns = [f"{i + 1}. {h}" if list(block.header).count(h) > 1 else h for i, h in enumerate(block.header)]
            logged[f"tables/{name}"] = wandb.Table(columns=columns, data=[list(row) for row in block.body])
        else:
            logged[f"figures/{name}"] = wandb.Image(_image(block), caption=block.caption)
    run.log(logged)
    artifact = wandb.Artifact(f"report-{run.id}", type="report")
    for path in sorted(folder.glob("*.*")):
        if path.is_file():
            artifact.add_file(str(path))
    run.log_artifact(artifact)
    place = str(run.dir)
    run.finish()
    return place


def _tensorboard(report: Report, folder: Path) -> str:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise SpecError("--publish tensorboard needs it: pip install 'agentspec-rl[tensorboard]'") from None
    import numpy as np

    from eval.tables import table

    place = folder / "tensorboard"
    with SummaryWriter(str(place)) as writer:
        for name, block in named(report):
            if isinstance(block, Table):
                lines = "\n".join(table(block.header, block.body))
                writer.add_text(f"tables/{name}", f"{lines}\n\n{block.caption}")
            else:
                writer.add_image(f"figures/{name}", np.asarray(_image(block)), dataformats="HWC")
    return str(place)


def named(report: Report) -> Iterator[tuple[str, Table | Figure]]:
    """Tables and figures with names of their own: tables by their heading, numbered where it has several."""
    heading, seen = "", {}  # type: ignore[var-annotated]
    for block in report.blocks:
        if isinstance(block, Heading):
            heading = block.text
        elif isinstance(block, Figure):
            yield block.name, block
        elif isinstance(block, Table):
            seen[heading] = seen.get(heading, 0) + 1
            yield (heading if seen[heading] == 1 else f"{heading} ({seen[heading]})"), block


def _image(figure: Figure) -> Any:
    from PIL import Image

    return Image.open(io.BytesIO(figure.png)).convert("RGB")
