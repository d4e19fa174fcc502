"""Prefix-tree updates: what rows share is computed once, forward and backward.

The rows of an update share long prefixes (the static prompt, a history that several rollouts have in common, the task
text before every summary). They are packed into a trie: its tokens stand side by side in one row of shape (1, N), each
with its position in its own sequence, and in every layer a node's queries look at the keys along their own path only.
Everything else in a decoder works token by token and does not notice. The log-probabilities of trained tokens are then
read off per row, so a shared token collects the gradients of all rows it belongs to: loss and gradients equal those of
separate padded rows.
"""
