"""Retroformer: what a lesson was worth, who is trained on it, and who is not."""

from __future__ import annotations

import pytest

from agentspec.episode import Job, Runner
from agentspec.llm.scripted import ScriptedLLM
from agentspec.reflection.retroformer import PATH, Retroformer
from agentspec.spec import AgentSpec
from agentspec.trajectory import Trajectory, read_trajectories, write_trajectories
from agentspec.types import Task
from tests.reasoning.numbers_env import NUMBERS
from tests.reflection.test_reflexion import SPEC, learner, module, run, trial
from trainers.sequences import TrainFilter, build_sequences

RETRO = {**SPEC, "reflection": "retroformer"}
AT_START = {**SPEC, "reflection": {"name": "retroformer", "when": "start"}}
"""How lessons are trained: the trial that a lesson is for begins with it, and pays for it."""


def chain(script, trials: int, spec: dict | None = None) -> list[Trajectory]:
    """Trials of one task, the lessons carried on."""
    runner = Runner(AgentSpec.from_data(spec or RETRO), ScriptedLLM(script))
    played, state = [], None
    for i in range(trials):
        played += runner.run([Job(Task(NUMBERS, 0), run_seed=i, memory_state=state)])
        state = played[-1].memory_state
    return played


def test_a_lesson_is_paid_the_change_of_return() -> None:
    retro, recorder = module(["a", "b", "c"], Retroformer, threshold=10.0)
    run(retro, trial(2.0))
    assert retro.metrics() == {}  # nothing to pay yet
    run(retro, trial(5.0, 1.0))
    # Lesson of trial 0 (call 0): 6 - 2 = 4.
    paid = retro.metrics()
    assert (paid["trial"], paid["call"], paid["return_before"], paid["return_after"], paid["reward"]) == (0, 0, 2, 6, 4)
    run(retro, trial(1.0))
    assert retro.metrics()["reward"] == -5.0 and retro.metrics()["call"] == 1
    assert [c.completions[0].credit for c in recorder.calls] == ["executed"] * 3


def test_lessons_of_one_task_are_not_paid_by_another() -> None:
    retro, _ = module(["a", "b", "c"], Retroformer, threshold=10.0)
    run(retro, trial(2.0), trial(9.0, task=Task(NUMBERS, 7)))
    assert retro.metrics() == {}
    run(retro, trial(3.0))
    assert retro.metrics()["reward"] == 1.0


def test_a_success_pays_and_writes_no_lesson() -> None:
    retro, recorder = module(["a", "b"], Retroformer, threshold=10.0)
    run(retro, trial(2.0), trial(12.0), trial(1.0))
    assert len(recorder.calls) == 2 and retro.metrics() == {}


def test_the_trial_that_pays_says_whose_call_it_pays(tmp_path) -> None:
    played = chain(learner, 2)
    assert played[1].metrics["reflection/reward"] == 1.0 and "reflection/reward" not in played[0].metrics
    write_trajectories(tmp_path / "t.jsonl", played)
    for stream in (played, list(read_trajectories(tmp_path / "t.jsonl"))):
        paid, lesson = stream[1].metrics, stream[0].calls[-1]
        assert (paid["reflection/episode"], paid["reflection/call"]) == (stream[0].episode, lesson.id)
        assert lesson.tag.path == PATH


def test_the_reflector_is_trained_and_the_actor_is_not() -> None:
    second = chain(learner, 2, AT_START)[1]
    (row,) = build_sequences(second, TrainFilter((PATH,)))
    lesson = second.calls[0]
    trained = [t for t, m in zip(row.tokens, row.mask, strict=True) if m]
    assert trained == list(lesson.completions[0].token_ids) and set(row.calls) == {-1, lesson.id}
    # And the other way round: training the actor leaves the reflector alone.
    actor = build_sequences(second, TrainFilter(("reasoning.*",)))
    assert actor and all(lesson.id not in row.calls for row in actor)
    # A lesson that is written when its episode is over earns nothing there.
    assert build_sequences(chain(learner, 1)[0], TrainFilter((PATH,))) == []


def test_gradients_reach_the_reflectors_adapter_only() -> None:
    """Two adapters on one base: the actor's stays as it is while the reflector's learns from its own tokens."""
    torch, peft = pytest.importorskip("torch"), pytest.importorskip("peft")
    from tests.tiny import tiny_model, tiny_tokenizer

    model = peft.get_peft_model(
        tiny_model(tiny_tokenizer()), peft.LoraConfig(r=2, target_modules=["q_proj"]), adapter_name="actor"
    )
    model.add_adapter("reflector", peft.LoraConfig(r=2, target_modules=["q_proj"]))
    model.set_adapter("reflector")
    (row,) = build_sequences(chain(learner, 2, AT_START)[1], TrainFilter((PATH,)))
    ids, mask = torch.tensor([row.tokens]) % model.config.vocab_size, torch.tensor([row.mask])
    logprobs = model(ids).logits[:, :-1].log_softmax(-1).gather(-1, ids[:, 1:, None])[..., 0]
    advantage = 1.0
    (-advantage * (logprobs * mask[:, 1:]).sum()).backward()
    for name, parameter in model.named_parameters():
        moved = parameter.grad is not None and bool(parameter.grad.abs().sum() > 0)
        assert moved == (".reflector." in name and "lora_B" in name), name
