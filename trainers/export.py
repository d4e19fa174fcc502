"""A trained run as a folder that stands on its own.

What training leaves is scattered: weights here or in the last checkpoint, optimiser states beside them, the scaffold in
the run's manifest. An export holds what is needed to act again and nothing else: the PEFT adapter (or the merged
model), the tokenizer with its chat template, and `agentspec.json`, which says what the adapter belongs to and which
scaffold it was trained in. Weights are safetensors throughout; nothing is ever unpickled.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from statistics import fmean
from typing import Any

from agentspec.files import file_digest, read_lines, write_atomic
from agentspec.llm.models import ModelNotFoundError, ModelSource, resolve
from agentspec.records.folder import MANIFEST as RUN_MANIFEST
from agentspec.records.folder import METRICS, checkpoints, digest_of
from agentspec.registry import SpecError
from agentspec.trajectory import versions
from trainers.card import FILE, model_card

MANIFEST = "agentspec.json"
FORMAT = 1

ADAPTER, ADAPTER_CONFIG = "adapter_model.safetensors", "adapter_config.json"
MODEL_FILES = ("config.json", "generation_config.json", "model.safetensors.index.json", "model*.safetensors")
TOKENIZER_FILES = (
    "tokenizer.json tokenizer_config.json special_tokens_map.json added_tokens.json chat_template.jinja vocab.json "
    "merges.txt tokenizer.model"
)


@dataclass(frozen=True)
class Trained:
    """The weights of a run: the folder they lie in, and whether they are an adapter or a whole model."""

    folder: Path
    adapter: bool


def export(run: str | Path, to: str | Path, merge: bool = False) -> Path:
    """Write the trained policy of `run` to `to`, which is given back, whole or not at all.

    Args:
    run: output folder of training: its final model, else its last complete checkpoint.
    to: folder to write; must not exist, or be empty.
    merge: merge an adapter into its base model's weights (in the base model's dtype), so that any loader of
        `transformers` reads the result. A run that trained all weights is a whole model either way.

    Raises:
    SpecError: there are no weights in `run`, or `to` holds something.
    ModelNotFoundError: the base model that an adapter needs cannot be found.
    """
    run, to = Path(run), Path(to)
    trained = find_trained(run)
    if to.exists() and (not to.is_dir() or any(to.iterdir())):
        raise SpecError(f"{to} exists and is not an empty folder; choose another one or remove it")
    to.parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(prefix=f".{to.name}-", dir=to.parent))
    try:
        recorded = _recorded(run)
        base = _base(recorded, trained)
        if base is None:
            _copy(trained.folder, work, MODEL_FILES)
        elif merge:
            _merge(trained.folder, base, work)
        else:
            _copy(trained.folder, work, (ADAPTER, ADAPTER_CONFIG))
            _name_base(work / ADAPTER_CONFIG, base)
        _tokenizer(trained.folder, base, work)
        manifest = _manifest(run, recorded, trained, base, work, merged=merge and trained.adapter)
        config = {**recorded["config"], "model": manifest["base_model"]["name"]}
        note = f"{manifest['kind']}, from the run's {manifest['source']}"
        adapter = trained.adapter and not merge
        write_atomic(work / FILE, model_card(to.name, config, manifest["scaffold"], adapter=adapter, note=note))
        manifest["files"] = {path.name: file_digest(path) for path in sorted(work.iterdir())}
        write_atomic(work / MANIFEST, json.dumps(manifest, indent=2, sort_keys=True) + "\n")
        work.chmod(0o755)  # temporary folders, and some writers' files, are private
        for path in work.iterdir():
            path.chmod(0o644)
        os.replace(work, to)  # onto an empty folder or nothing
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return to


def find_trained(run: Path) -> Trained:
    """The final weights of a run, or those of its last complete checkpoint; `SpecError` without either."""
    if not run.is_dir():
        raise SpecError(f"no run folder {run}; give the output_dir of a training run")
    for folder in (run, *reversed(checkpoints(run))):
        if (folder / ADAPTER).is_file() and (folder / ADAPTER_CONFIG).is_file():
            return Trained(folder, adapter=True)
        single, sharded = folder / "model.safetensors", folder / "model.safetensors.index.json"
        if (folder / "config.json").is_file() and (single.is_file() or sharded.is_file()):
            return Trained(folder, adapter=False)
    raise SpecError(
        f"{run} holds no trained weights: neither {ADAPTER} nor model.safetensors, there or in a complete checkpoint; "
        "let training reach a checkpoint (save_steps) or its end"
    )


def _base(run: Mapping[str, Any], trained: Trained) -> ModelSource | None:
    """The model an adapter belongs to.

    What the adapter itself says counts; the run's configuration knows the name it was asked for by, and stands in when
    the adapter names nothing that exists here.
    """
    if not trained.adapter:
        return None
    config = trained.folder / ADAPTER_CONFIG
    recorded = json.loads(config.read_text(encoding="utf-8")).get("base_model_name_or_path")
    sources: dict[str, str] = {}
    problem = ModelNotFoundError(
        f"neither the run's {RUN_MANIFEST} nor the adapter says which model it was trained on; write its name into "
        f"base_model_name_or_path of {config}"
    )
    for name in filter(None, (run["config"].get("model"), recorded)):
        try:
            sources[name] = resolve(name).path
        except ModelNotFoundError as error:
            problem = error
    if not sources:
        raise problem
    path = list(sources.values())[-1]
    return ModelSource(path, next(name for name, found in sources.items() if found == path))


def _merge(adapter: Path, base: ModelSource, to: Path) -> None:
    """Write base model + adapter as one model.

    The sum is formed in single precision even for a half-precision base: rounding happens once, when saving.
    """
    import torch
    from peft import PeftModel
    from transformers import AutoModelForCausalLM

    model = AutoModelForCausalLM.from_pretrained(base.path, dtype="auto")
    dtype = model.dtype
    model = PeftModel.from_pretrained(model.to(torch.float32), str(adapter), is_trainable=False)
    merged = model.merge_and_unload(safe_merge=True).to(dtype)
    merged.save_pretrained(to)


def _name_base(config: Path, base: ModelSource) -> None:
    """Let the adapter's configuration name a base model that PEFT's own loaders find on this machine."""
    data = json.loads(config.read_text(encoding="utf-8"))
    write_atomic(config, json.dumps(data | {"base_model_name_or_path": base.path}, indent=2, sort_keys=True) + "\n")


def _tokenizer(folder: Path, base: ModelSource | None, to: Path) -> None:
    """The run's tokenizer; the base model's where the run has none."""
    if _copy(folder, to, TOKENIZER_FILES.split()) or base is None:
        return
    from transformers import AutoTokenizer

    AutoTokenizer.from_pretrained(base.path).save_pretrained(to)


def _copy(source: Path, to: Path, patterns: Iterable[str]) -> int:
    """Copy the files that match; how many there were."""
    paths = {path for pattern in patterns for path in source.glob(pattern) if path.is_file()}
    for path in paths:
        shutil.copyfile(path, to / path.name)
    return len(paths)


def _manifest(
    run: Path, recorded: Mapping[str, Any], trained: Trained, base: ModelSource | None, work: Path, *, merged: bool
) -> dict[str, Any]:
    config = recorded["config"]
    more = {name: metadata.version(name) for name in ("peft", "safetensors", "trl")}
    return {
        "format": FORMAT,
        "kind": "merged model" if merged else "adapter" if trained.adapter else "model",
        "source": "final model" if trained.folder == run else trained.folder.name,
        "base_model": {
            "name": base.name if base else config.get("model") or "",
            "path": base.path if base else "",
            "revision": _revision(base),
        },
        "scaffold": recorded.get("spec") or config.get("agent"),
        "environment": config.get("environment"),
        "template_sha256": digest_of(work / "chat_template.jinja"),
        "tokenizer_sha256": digest_of(work / "tokenizer.json"),
        "versions": {"export": versions() | more, "training": recorded.get("versions", {})},
        "rewards": reward_summary(read_lines(run / METRICS)),
    }


def reward_summary(rows: Iterable[dict[str, Any]], *, key: str = "reward", window: int = 5) -> dict[str, Any]:
    """The reward curve in a few numbers.

    Returns:
        `steps` (last logged step), `first` and `last` (means of the first and last `window` logged values),
        `best` and `best_step`; empty without a logged reward.
    """
    points = [(row["step"], float(row[key])) for row in rows if row.get(key) is not None and "step" in row]
    if not points:
        return {}
    values = [value for _, value in points]
    best_step, best = max(points, key=lambda p: p[1])
    ends = {"first": fmean(values[:window]), "last": fmean(values[-window:])}
    return {"steps": points[-1][0], **ends, "best": best, "best_step": best_step}


def _recorded(run: Path) -> dict[str, Any]:
    """What the run's manifest says, its `config` among it; an empty one without a manifest."""
    path = run / RUN_MANIFEST
    data = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    return {**data, "config": data.get("config") or {}}


def _revision(base: ModelSource | None) -> str:
    """The commit of a hub model, as its cached configuration records it; empty for a folder."""
    if base is None or Path(base.path).is_dir():
        return ""
    from transformers import AutoConfig

    return str(getattr(AutoConfig.from_pretrained(base.path), "_commit_hash", None) or "")
