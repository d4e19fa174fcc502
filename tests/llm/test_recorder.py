"""The recorder numbers, seeds, meters, credits and limits the calls of an episode."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from agentspec.llm.base import user
from agentspec.llm.pricing import Price, Prices
from agentspec.llm.recorder import Budget, BudgetExceededError, ModuleLLM, Recorder, derive_seed
from agentspec.llm.scripted import ScriptedLLM
from agentspec.types import Sampling, Usage

ASK = [user("u")]  # 4 prompt tokens; the answer "ok" has 3


def recorder(llm: ScriptedLLM | None = None, **kwargs) -> Recorder:
    return Recorder(llm or ScriptedLLM(["ok"]), episode="e", seed=7, **kwargs)


def test_calls_are_numbered_seeded_and_tagged():
    seen = []
    llm = ScriptedLLM(lambda r: (seen.append(r), "ok")[1])
    rec = recorder(llm, sampling=Sampling(max_tokens=50))
    rec.step = 3
    call = asyncio.run(ModuleLLM(rec, "reasoning.react").generate("act", ASK, temperature=0.5, branch="b1"))
    asyncio.run(rec.generate("memory.summary", "write", ASK))
    assert [r.id for r in seen] == [0, 1]
    assert [r.seed for r in seen] == [derive_seed(7, 0), derive_seed(7, 1)]
    assert (call.tag.path, call.tag.episode, call.tag.step, call.tag.branch) == ("reasoning.react/act", "e", 3, "b1")
    assert seen[0].sampling == Sampling(temperature=0.5, max_tokens=50)
    assert seen[1].sampling == Sampling(max_tokens=50)
    assert rec.calls[0] is call


def test_seeds_depend_on_every_part_only():
    assert derive_seed(1, "a") == derive_seed(1, "a")
    assert len({derive_seed(1, "a"), derive_seed(2, "a"), derive_seed(1, "b"), derive_seed("1a"), derive_seed()}) == 5
    assert 0 <= derive_seed("x") < 2**63


def test_usage_and_cost_add_up():
    prices = Prices({"script": Price(input=1.0, output=10.0), "scripted": Price(input=2.0, output=100.0)})
    rec = recorder(prices=prices)
    for _ in range(2):
        asyncio.run(rec.generate("m", "p", ASK))
    # Twice (4 in at $2 + 3 out at $100) per million: the longest matching name counts.
    assert rec.usage == Usage(8, 6, 0, pytest.approx(2 * 308e-6))


def test_cached_tokens_have_their_own_price():
    usage = Usage(input_tokens=10, output_tokens=0, cached_tokens=4)
    assert Prices({"m": Price(2.0, 0.0, cached=0.5)}).cost("m-large", usage) == pytest.approx((6 * 2 + 4 * 0.5) / 1e6)
    assert Prices({"m": Price(2.0)}).cost("m", usage) == pytest.approx(20e-6)
    assert Prices({"m": Price(2.0)}).cost("other", usage) == 0.0


def test_prices_from_yaml(tmp_path: Path):
    path = tmp_path / "prices.yaml"
    path.write_text("gpt-x:\n  input: 2.5\n  output: 10\n", encoding="utf-8")
    assert Prices.from_yaml(path).table == {"gpt-x": Price(2.5, 10)}
    path.write_text("- 1\n", encoding="utf-8")
    with pytest.raises(ValueError, match="expected a mapping"):
        Prices.from_yaml(path)


@pytest.mark.parametrize(
    ("budget", "calls"),
    # A call costs 7 tokens and 7e-6 dollars: the third is refused at 2 calls, at 14 tokens and at 1.4e-5 dollars.
    [(Budget(calls=2), 2), (Budget(tokens=14), 2), (Budget(tokens=15), 3), (Budget(cost=1.4e-5), 2), (Budget(), 5)],
)
def test_budget_refuses_the_call_that_would_start_past_it(budget, calls):
    rec = recorder(budget=budget, prices=Prices({"scripted": Price(1.0, 1.0)}))
    made = 0
    try:
        for _ in range(5):
            asyncio.run(rec.generate("m", "p", ASK))
            made += 1
    except BudgetExceededError as error:
        assert "budget" in str(error)
    assert made == calls == len(rec.calls)


def test_concurrent_calls_count_when_they_are_made():
    rec = recorder(budget=Budget(calls=2))

    async def main():
        calls = [rec.generate("m", "p", ASK) for _ in range(3)]
        return await asyncio.gather(*calls, return_exceptions=True)

    results = asyncio.run(main())
    assert sum(isinstance(r, BudgetExceededError) for r in results) == 1


def test_credit_marks_one_completion():
    rec = recorder()
    call = asyncio.run(rec.generate("m", "p", ASK, n=2))
    rec.credit(call.id, 1, "executed")
    assert [c.credit for c in rec.calls[0].completions] == ["aux", "executed"]
    with pytest.raises(KeyError, match="call 5 was not made"):
        rec.credit(5, 0, "executed")


def test_module_scores_and_counts():
    llm = ModuleLLM(recorder(), "m")
    assert asyncio.run(llm.score(ASK, ["ab"])) == (-2.0,)
    assert llm.count_tokens("abc") == 3


def test_scorings_are_metered_and_bounded_by_tokens():
    llm = ScriptedLLM(["ok"], score=lambda messages, continuation: 0.0)
    rec = recorder(llm, prices=Prices({"scripted": Price(input=2.0)}), budget=Budget(tokens=8))
    view = ModuleLLM(rec, "reasoning.rap")
    assert asyncio.run(view.score([user("abc")], ["de", "f"])) == (0.0, 0.0)
    # Read as bytes: 3 of the prompt, 2 + 1 of the continuations; nothing is sampled, so it is no call.
    assert rec.usage == Usage(6, 0, 0, pytest.approx(12e-6)) and rec.calls == [] and rec.scorings == 1
    asyncio.run(view.score([user("abc")], ["de"]))
    with pytest.raises(BudgetExceededError, match="budget of 8 tokens"):
        asyncio.run(view.score([user("abc")], ["de"]))
