"""A report in W&B (offline) and TensorBoard."""

from __future__ import annotations

from pathlib import Path

import pytest

from agentspec.registry import SpecError
from eval.report import Report, write_files
from eval.report.blocks import Heading, Table
from eval.report.figures import bars
from eval.report.publish import named, publish
from eval.statistics import Estimate

FIGURE = bars("gains", ["a"], {"x": {"a": Estimate(1.0, 0.5, 1.5, 4)}}, heading="$", caption="n = 4")
TABLES = [Table(["a", "b"], [["1", "2"]], "n = 1"), Table(["a", "a"], [["3", "4"]], "n = 1")]
REPORT = Report("Toy", [Heading("Toy", 1), Heading("gains"), TABLES[0], FIGURE, TABLES[1]], [{"policy": "p"}])


def test_tables_and_figures_have_names_of_their_own() -> None:
    assert [name for name, _ in named(REPORT)] == ["gains", "gains", "gains (2)"]


def test_weights_and_biases_offline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("wandb", reason="needs wandb: pip install 'agentspec-rl[wandb]'")
    monkeypatch.setenv("WANDB_MODE", "offline")
    write_files(REPORT, tmp_path)
    place = Path(publish(REPORT, tmp_path, "wandb"))
    kept = {path.name for path in place.parent.rglob("*") if path.is_file()}
    assert any(name.endswith(".wandb") for name in kept) and any(name.startswith("gains") for name in kept)


def test_tensorboard(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard", reason="needs tensorboard: pip install 'agentspec-rl[tensorboard]'")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    write_files(REPORT, tmp_path)
    events = EventAccumulator(publish(REPORT, tmp_path, "tensorboard"))
    events.Reload()
    assert events.Tags()["images"] == ["figures/gains"]
    assert [tag.removesuffix("/text_summary") for tag in events.Tags()["tensors"]] == [
        "tables/gains",
        "tables/gains (2)",
    ]


def test_an_unknown_tracker(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="expected one of wandb, tensorboard"):
        publish(REPORT, tmp_path, "mlflow")
