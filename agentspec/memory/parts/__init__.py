"""What several memory methods are written with; none of it is a method.

- `entries`: texts with the time they are from, searched by meaning and by words, capped.
- `steps`: the text of a step, the newest steps within a budget, whole sentences of an answer that was cut off.
- `telling`: steps told to a curator within a budget of tokens, with actions never clipped before states.
"""
