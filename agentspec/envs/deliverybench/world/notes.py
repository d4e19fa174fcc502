"""Customers' notes: a wish in words, and the hand-over methods that satisfy it.

The wording is our own; what matters to the simulation is the list of methods and its order, because an order draws its
note by position. An order without a note accepts every method.
"""

from __future__ import annotations

LEAVE, KNOCK, CALL, HAND = "leave_at_door", "knock", "call", "hand_to_customer"

METHODS: tuple[str, ...] = (LEAVE, KNOCK, CALL, HAND)
"""All hand-over methods of DROP_OFF."""

NOTES: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("Nobody needs to come out: put the bag down at the door.", (LEAVE,)),
    ("Let me know that you are here, by knocking, by phone or in person.", (KNOCK, HAND, CALL)),
    ("The bell is broken, so knock.", (KNOCK,)),
    ("Ring my phone when you arrive.", (CALL,)),
    ("Doorstep is fine; a knock is welcome too.", (LEAVE, KNOCK)),
    ("I am waiting outside and will take it from you.", (HAND,)),
    ("Meeting in progress: leave it at the door, no noise.", (LEAVE,)),
    ("The baby sleeps. Doorstep, quietly.", (LEAVE,)),
    ("I am out; set it down at the door.", (LEAVE,)),
    ("I have a cold, please keep your distance and leave it at the door.", (LEAVE,)),
    ("There is a box beside the door, put it in there.", (LEAVE,)),
    ("Please do not knock: nervous dog. Doorstep.", (LEAVE,)),
    ("Night shift, I sleep by day. Just leave it at the door.", (LEAVE,)),
    ("Put it on the mat, I will fetch it later.", (LEAVE,)),
    ("Call me, I cannot hear the door from the yard.", (CALL,)),
    ("Phone when you are here and I will come down.", (CALL,)),
    ("A short call, please; no knocking.", (CALL,)),
    ("The entrance is locked. Call and I will open.", (CALL,)),
    ("I wear headphones: only a phone call reaches me.", (CALL,)),
    ("Two knocks, so that I know it is the food.", (KNOCK,)),
    ("Make yourself heard: knock or call.", (KNOCK, CALL)),
    ("No phone here today, so knock.", (KNOCK,)),
    ("Birthday surprise: hand it to me in person, away from the door.", (HAND,)),
    ("I stand near the entrance, please give it to me directly.", (HAND,)),
    ("Do not leave it unattended; hand it over.", (HAND,)),
    ("Things vanish from this doorstep: only into my hands.", (HAND,)),
    ("I will meet you a few steps from the house.", (HAND,)),
    ("I am in the front garden, bring it to me.", (HAND,)),
    ("Please wait for me outside and pass it to me.", (HAND,)),
    ("Knock, or simply leave it at the door.", (LEAVE, KNOCK)),
    ("Doorstep is fine, knock if you like.", (LEAVE, KNOCK)),
    ("Set it down or knock, whichever is quicker.", (LEAVE, KNOCK)),
    ("Grandmother opens, she only hears a firm knock.", (KNOCK,)),
    ("Contactless, please: at the door.", (LEAVE,)),
    ("I pick it up from the doorstep after work.", (LEAVE,)),
)
