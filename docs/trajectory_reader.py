"""Reads trajectory files with nothing but the standard library: formats 1 and 2."""

import json


def read_episodes(path):
    """Every episode of a file as plain data; each call has its whole prompt under `prompt_ids`."""
    with open(path, encoding="utf-8") as file:
        for line in file:
            if not line.endswith("\n"):
                break  # cut short while it was being written
            episode = json.loads(line)
            if episode["format"] not in (1, 2):
                raise ValueError(f"format {episode['format']}: this reader knows 1 and 2")
            before = []
            for call in episode["calls"]:
                kept, new = stored_prompt(call)
                call["prompt_ids"] = before[:kept] + new
                first = call["completions"][0]["token_ids"] if call["completions"] else []
                before = call["prompt_ids"] + first
            yield episode


def stored_prompt(call):
    """How many tokens the prompt keeps of those before it, and the tokens that follow them."""
    if "prompt" in call:
        return call["prompt"]["kept"], call["prompt"]["new"]
    kept, *new = call["prompt_ids"]  # format 1
    return kept, new


def sampled_tokens(episode):
    """Every sampled token with what it was sampled from.

    Yields (prompt, position, token, log-probability, temperature, allowed): `prompt` holds all tokens before the
    completion, `allowed` the ids that a constraint left (`None`: all of the vocabulary).
    """
    for call in episode["calls"]:
        temperature = call["sampling"]["temperature"]
        for completion in call["completions"]:
            ids, logprobs = completion["token_ids"], completion["logprobs"]
            allowed = completion["allowed"] or [None] * len(ids)
            for position, (token, logprob, ids_left) in enumerate(zip(ids, logprobs, allowed, strict=True)):
                yield call["prompt_ids"] + ids[:position], position, token, logprob, temperature, ids_left
