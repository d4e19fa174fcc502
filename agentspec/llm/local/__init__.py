"""The local backend: a live transformers model, possibly the very one under training.

`backend` turns requests into jobs and answers them; `engine` drives them through the model with the `scheduler`
deciding which rows share a forward; `forward` is the packed forward and `attention` its attention; `cache` keeps keys
and values by prefix; `rows` and `sampling` say what a row does with its logits; `adapters` which LoRA adapter answers;
`invariance` makes a token's logits independent of the batch, `blocks` finds out how few keys that allows attention to
read, and `probe` whether they are; `last_layer` leaves out what nobody asks for.
"""

from agentspec.llm.local.backend import LocalLLM

__all__ = ["LocalLLM"]
