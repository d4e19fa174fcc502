"""The shipped launch configurations, what each layout refuses, and the step of sharded processes against one's.

accelerate uses FSDP only on accelerators; two CPU processes are told to shard nevertheless, and from there on all
is accelerate's and torch's own FSDP 2, over gloo. DeepSpeed runs on CPUs as it is, where it is installed.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("trl")

import torch
from accelerate.commands.config.config_args import ClusterConfig, load_config_from_file
from accelerate.commands.launch import _validate_launch_command, launch_command_parser
from accelerate.state import AcceleratorState
from accelerate.utils import DistributedType, FullyShardedDataParallelPlugin, prepare_multi_gpu_env
from safetensors.torch import load_file, save_file
from trl.distributed import DistributedBackend

from agentspec.records.log import RunLog
from agentspec.registry import SpecError
from tests.tiny import tiny_tokenizer
from tests.trainers.builders import call, episode, instead_of_playing
from tests.trainers.fake_vllm import use_fake_vllm
from tests.trainers.test_data_parallel import built_episode, make_trainer
from tests.trainers.test_supo import configured
from trainers import grpo as grpo_module
from trainers import policy_loss
from trainers.distributed import check_layout, check_trained, end_process, keep_precision
from trainers.tree import model as tree_model

ROOT = Path(__file__).resolve().parents[2]
LAYOUTS = ROOT / "recipes" / "accelerate"
ZERO = {"deepspeed_zero2": 2, "deepspeed_zero3": 3}
CASES = ("tree", "kl", "idle", "failed")


def launched(name: str) -> Any:
    """The arguments that ``accelerate launch --config_file`` makes of a file."""
    arguments = ["--config_file", str(LAYOUTS / f"{name}.yaml"), "script.py"]
    return _validate_launch_command(launch_command_parser().parse_args(arguments))[0]


# --- the files -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", sorted(LAYOUTS.glob("*.yaml")), ids=lambda p: p.stem)
def test_accelerate_knows_every_field(path: Path) -> None:
    config = load_config_from_file(str(path))  # refuses unknown keys on the top level
    assert isinstance(config, ClusterConfig) and config.num_processes > 1
    arguments = launched(path.stem)
    known = vars(launch_command_parser().parse_args(["script.py"]))
    for section in (config.fsdp_config, config.deepspeed_config):
        assert set(section) <= set(known)  # accelerate copies what is in a section and ignores what it does not know
        assert all(getattr(arguments, key) == value for key, value in section.items())
    assert arguments.num_processes == config.num_processes
    # Some launcher starts more than one process.
    assert arguments.multi_gpu or arguments.use_fsdp or arguments.use_deepspeed


def test_the_layouts() -> None:
    names = {p.stem for p in LAYOUTS.glob("*.yaml")}
    assert names == {"cpu2", "ddp", "fsdp", "deepspeed_zero2", "deepspeed_zero3"}
    assert launched("ddp").multi_gpu and launched("cpu2").multi_gpu
    assert [launched(f"deepspeed_zero{stage}").zero_stage for stage in (2, 3)] == [2, 3]


def test_the_fsdp_plugin(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in prepare_multi_gpu_env(launched("fsdp")).items():
        monkeypatch.setenv(name, value)
    plugin = FullyShardedDataParallelPlugin()
    assert plugin.fsdp_version == 2 and plugin.reshard_after_forward is True
    assert plugin.auto_wrap_policy is not None and not plugin.cpu_ram_efficient_loading
    assert str(plugin.state_dict_type).endswith("FULL_STATE_DICT")


@pytest.mark.parametrize("stage", [2, 3])
def test_the_deepspeed_plugin(stage: int) -> None:
    pytest.importorskip("deepspeed")
    from accelerate.utils import DeepSpeedPlugin

    config = load_config_from_file(str(LAYOUTS / f"deepspeed_zero{stage}.yaml")).deepspeed_config
    plugin = DeepSpeedPlugin(
        zero_stage=config["zero_stage"],
        offload_optimizer_device=config["offload_optimizer_device"],
        offload_param_device=config["offload_param_device"],
        zero3_init_flag=config["zero3_init_flag"],
    )
    assert plugin.deepspeed_config["zero_optimization"]["stage"] == stage


# --- what is refused -------------------------------------------------------------------------------------------------


def layout(fsdp: int | None = None, zero: int = 0) -> Any:
    """An accelerator, as far as the layout goes."""
    deepspeed = SimpleNamespace(zero_stage=zero) if zero else None
    sharded = SimpleNamespace(fsdp_version=fsdp) if fsdp else None
    return SimpleNamespace(state=SimpleNamespace(deepspeed_plugin=deepspeed, fsdp_plugin=sharded))


def test_what_would_hang_is_refused(tmp_path: Path) -> None:
    local, vllm = configured(tmp_path), configured(tmp_path, use_vllm=True)
    for accelerator in (layout(), layout(zero=1), layout(zero=2)):
        check_layout(accelerator, local)
        check_layout(accelerator, configured(tmp_path, packing="padded", tokens_per_forward=100))
    for accelerator in (layout(fsdp=2), layout(zero=3)):
        check_layout(accelerator, vllm)
        with pytest.raises(SpecError, match="use_vllm: true"):
            check_layout(accelerator, local)
        for changes in ({"packing": "padded"}, {"tokens_per_forward": 100}):
            with pytest.raises(SpecError, match=r"number\s+of forwards would differ"):
                check_layout(accelerator, configured(tmp_path, use_vllm=True, **changes))
    with pytest.raises(SpecError, match="fsdp_version: 2"):
        check_layout(layout(fsdp=1), vllm)


def test_log_probabilities_are_not_rounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FSDP_VERSION", "2")
    plugin = FullyShardedDataParallelPlugin()
    plugin.set_mixed_precision("bf16")
    assert plugin.mixed_precision_policy.output_dtype == torch.bfloat16  # what accelerate asks for
    keep_precision(SimpleNamespace(state=SimpleNamespace(fsdp_plugin=plugin)))
    policy = plugin.mixed_precision_policy
    assert policy.param_dtype == torch.bfloat16 and policy.output_dtype is None and not policy.cast_forward_inputs
    keep_precision(layout())


def test_all_ranks_judge_the_batch_together(tmp_path: Path) -> None:
    config = configured(tmp_path, train_calls=["reasoning.*"])
    trained = episode([call(0, [1], [2])], [1.0])
    other = episode([call(0, [1], [2], module="memory.summary", purpose="summary")], [1.0])
    failed = episode([], [1.0], status="failed")

    def judge(*ranks: Any) -> list[bool]:
        """Whether each rank raises, given the episodes of all."""
        sent: list[Any] = []
        for mine in ranks:
            with suppress(SpecError):
                check_trained(mine, config.train_filter, lambda row: sent.extend(row) or row)
        raised = []
        for mine in ranks:
            try:
                check_trained(mine, config.train_filter, lambda _: sent)
                raised.append(False)
            except SpecError as error:
                assert "memory.summary/summary" in str(error)
                raised.append(True)
        return raised

    assert judge([trained], [other]) == [False, False]  # the batch has something to train
    assert judge([other], [other]) == judge([failed], [other]) == [True, True]
    assert judge([failed], [failed]) == [False, False]  # nothing to judge by


# --- two processes ---------------------------------------------------------------------------------------------------


def shard_on_cpu(precision: str = "") -> None:
    """Make accelerate shard on the CPU, with the plugin that its launcher's environment describes."""
    start, plugin = AcceleratorState.__init__, FullyShardedDataParallelPlugin()
    if precision:
        plugin.set_mixed_precision(precision)

    def sharded(self: Any, *args: Any, **kwargs: Any) -> None:
        start(self, *args, **kwargs)
        if self.distributed_type == DistributedType.MULTI_CPU:
            self._shared_state["distributed_type"] = DistributedType.FSDP
            self._shared_state["fsdp_plugin"] = plugin

    AcceleratorState.__init__ = sharded  # type: ignore[method-assign]


def run_cases(out: Path, name: str) -> None:
    """What every process does: train each case on given episodes, and push the result to vLLM."""
    patch = pytest.MonkeyPatch()
    use_fake_vllm(patch, tiny_tokenizer().eos_token_id)
    patch.setattr(tree_model, "HEAD_CHUNK", 5)  # ranks project different numbers of chunks on the vocabulary
    if name == "fsdp":
        shard_on_cpu()
    for case in CASES:
        patch.setattr(
            grpo_module,
            "collect",
            instead_of_playing(lambda jobs, case=case: [built_episode(case, j) for j in jobs]),
        )
        trainer = make_trainer(out / case, case, use_vllm=True, vllm_importance_sampling_correction=False)
        backend = DistributedBackend(trainer.accelerator)
        assert trainer.accelerator.num_processes == (1 if name == "alone" else 2)
        assert (backend.is_fsdp, backend.zero_stage) == (name == "fsdp", ZERO.get(name, 0))
        trainer.train()
        weights = trainer.accelerator.get_state_dict(trainer.model_wrapped)
        with trainer._current_weights():
            given = dict(trainer.vllm_generation.llm.model.named_parameters())
        if trainer.accelerator.is_main_process:
            save_file({n: w.clone().contiguous() for n, w in weights.items()}, out / f"{case}.safetensors")
            save_file({n: w.clone().contiguous() for n, w in given.items()}, out / f"{case}.pushed.safetensors")
        trainer.accelerator.wait_for_everyone()


def step_in_bfloat16() -> None:
    """One update as the shipped layout computes it on a GPU."""
    use_fake_vllm(pytest.MonkeyPatch(), tiny_tokenizer().eos_token_id)
    shard_on_cpu("bf16")
    compute = policy_loss.rows_logprobs

    def checked(*args: Any, **kwargs: Any) -> Any:
        logps, entropies = compute(*args, **kwargs)
        assert logps.dtype == torch.float32 and not torch.equal(logps, logps.bfloat16().float())
        return logps, entropies

    patch = pytest.MonkeyPatch()
    patch.setattr(policy_loss, "rows_logprobs", checked)
    patch.setattr(grpo_module, "collect", instead_of_playing(lambda jobs: [built_episode("tree", j) for j in jobs]))
    settings = {"use_vllm": True, "bf16": True, "max_steps": 1}
    make_trainer(Path(sys.argv[2]), "tree", **settings).train()


def fail_alone() -> None:
    """The second process cannot play; the first has played and waits for it."""
    trainer = make_trainer(Path(sys.argv[2]), "tree")
    rank = trainer.accelerator.process_index

    def play(jobs: Any) -> Any:
        if rank == 1:
            raise SpecError("rank 1 cannot play")
        return [built_episode("tree", j) for j in jobs]

    pytest.MonkeyPatch().setattr(grpo_module, "collect", instead_of_playing(play))
    trainer.train()


def on_cpu() -> dict[str, str]:
    return {**os.environ, "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": "", "DS_ACCELERATOR": "cpu"}


def launch(name: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """This file under ``accelerate launch`` with a shipped layout, two processes, on the CPU."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "accelerate.commands.launch", "--config_file", str(LAYOUTS / f"{name}.yaml")]
    command += ["--num_processes", "2", "--mixed_precision", "no", "--main_process_port", str(port)]
    command += ["-m", "tests.trainers.test_distributed", *arguments]
    environment = on_cpu()
    return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=600, check=False)


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the run with one process."""
    out = tmp_path_factory.mktemp("alone")
    command = [sys.executable, "-m", "tests.trainers.test_distributed", "cases", str(out), "alone"]
    done = subprocess.run(command, cwd=ROOT, env=on_cpu(), capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr[-4000:]
    return out


@pytest.fixture(scope="module", params=["fsdp", *ZERO])
def runs(alone: Path, tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> tuple[Path, Path]:
    """Folders of the run with one process and of that with two."""
    if request.param in ZERO:
        pytest.importorskip("deepspeed")
    out = tmp_path_factory.mktemp(request.param)
    done = launch(request.param, "cases", str(out), request.param)
    assert done.returncode == 0, done.stderr[-4000:]
    return alone, out


@pytest.mark.parametrize("case", CASES)
def test_sharded_processes_take_the_step_of_one(runs: tuple[Path, Path], case: str) -> None:
    one, two = (load_file(folder / f"{case}.safetensors") for folder in runs)
    assert one.keys() == two.keys()
    assert max((one[n] - two[n]).abs().max().item() for n in one) < 1e-6


@pytest.mark.parametrize("case", CASES)
def test_vllm_is_given_whole_weights_with_the_adapter_in_them(runs: tuple[Path, Path], case: str) -> None:
    pushed = [load_file(folder / f"{case}.pushed.safetensors") for folder in runs]
    assert pushed[0].keys() == pushed[1].keys()
    assert max((pushed[0][n] - pushed[1][n]).abs().max().item() for n in pushed[0]) < 1e-6
    trained = load_file(runs[1] / f"{case}.safetensors")
    if case == "kl":  # the case with an adapter: alpha 4, rank 2
        name = "model.layers.0.self_attn.q_proj"
        a, b, base = (trained[f"base_model.model.{name}.{part}"] for part in _LORA)
        expected = base + 2.0 * b @ a
        assert b.abs().max() > 0
        torch.testing.assert_close(pushed[1][f"{name}.weight"], expected)
    else:
        assert all(torch.equal(pushed[1][n], trained[n]) for n in pushed[1])


_LORA = ("lora_A.default.weight", "lora_B.default.weight", "base_layer.weight")


def test_fsdp_in_bfloat16(tmp_path: Path) -> None:
    done = launch("fsdp", "bfloat16", str(tmp_path / "run"))
    assert done.returncode == 0, done.stderr[-4000:]
    (step,) = RunLog(tmp_path / "run").read("metrics.jsonl")
    assert step["grad_norm"] > 0


def test_a_rank_that_fails_alone_ends_the_run(tmp_path: Path) -> None:
    """The launcher ends the processes that wait for it; nobody hangs until a collective's half-hour limit."""
    start = time.monotonic()
    done = launch("cpu2", "fail", str(tmp_path / "run"))
    assert done.returncode != 0 and "rank 1 cannot play" in done.stderr
    assert time.monotonic() - start < 300


if __name__ == "__main__":
    if sys.argv[1] == "fail":
        fail_alone()
    elif sys.argv[1] == "bfloat16":
        step_in_bfloat16()
    else:
        run_cases(Path(sys.argv[2]), sys.argv[3])
    end_process()
