"""Types of household objects: what can be done with each, and a size for those whose scene does not record one.

Names and abilities are those of AI2-THOR's object types; the sizes are ours (metres: width, height, depth).
"""

from __future__ import annotations

from dataclasses import dataclass

ABILITIES = {
    "p": "pickupable",
    "r": "receptacle",
    "o": "openable",
    "t": "toggleable",
    "s": "sliceable",
    "m": "moveable",
}

_TABLE = """
AlarmClock p .1 .1 .08; AluminumFoil p .3 .06 .06; Apple ps .09 .09 .09; ArmChair r .8 .9 .8; BaseballBat p .08 .75 .08
BasketBall p .24 .24 .24; Bathtub r 1.6 .6 .8; BathtubBasin r 1.4 .4 .6; Bed r 1.8 .7 2.2; Blinds o 1 1.2 .05
Book po .24 .03 .2; Boots p .3 .25 .3; Bottle p .08 .25 .08; Bowl pr .16 .07 .16; Box opr .35 .25 .3
Bread ps .28 .13 .13; ButterKnife p .2 .02 .03; Cabinet ro .5 .7 .4; Candle pt .08 .12 .08; Cart r .6 .9 .4
CD p .12 .01 .12; CellPhone pt .08 .02 .15; Chair rm .5 .9 .5; Cloth p .25 .02 .2; CoffeeMachine rtm .2 .35 .3
CoffeeTable r 1 .45 .6; CounterTop r 1.8 .95 .65; CreditCard p .09 .01 .06; Cup pr .09 .11 .09; Curtains o 1 1.5 .05
Desk r 1.3 .75 .65; DeskLamp tm .2 .45 .2; Desktop m .4 .45 .3; DiningTable r 1.4 .75 .9; DishSponge p .11 .03 .08
DogBed r .8 .2 .6; Drawer ro .5 .18 .4; Dresser r 1.2 .9 .5; Egg ps .05 .06 .05; Faucet t .12 .25 .2
FloorLamp tm .35 1.6 .35; Footstool r .5 .4 .5; Fork p .2 .02 .03; Fridge ro .8 1.75 .7; GarbageBag m .4 .5 .4
GarbageCan rm .35 .45 .35; Glassbottle p .08 .28 .08; HandTowel p .2 .3 .05; HousePlant m .3 .5 .3; Kettle p .2 .22 .2
KeyChain p .1 .02 .06; Knife p .28 .03 .04; Ladle p .28 .08 .09; Lamp tm .3 .5 .3; Laptop pot .34 .24 .26
LaundryHamper ro .45 .6 .45; LaundryHamperLid m .45 .05 .45; Lettuce ps .2 .17 .2; LightSwitch t .1 .15 .02
Microwave rotm .5 .3 .4; Mirror _ .8 1 .05; Mug pr .09 .1 .12; Newspaper p .35 .03 .25; Ottoman r .5 .4 .5
Painting _ .8 .6 .05; Pan pr .28 .06 .4; PaperTowel p .12 .25 .12; PaperTowelRoll p .12 .25 .12; Pen p .14 .01 .02
Pencil p .16 .01 .02; PepperShaker p .05 .1 .05; Pillow p .4 .14 .35; Plate pr .24 .03 .24; Plunger p .15 .45 .15
Poster _ .6 .8 .02; Pot pr .26 .16 .32; Potato ps .1 .08 .08; RemoteControl p .06 .03 .17; Safe ro .45 .5 .45
SaltShaker p .05 .1 .05; ScrubBrush p .1 .35 .1; Shelf r .6 .3 .25; ShelvingUnit m .7 1.2 .3; ShowerDoor o .8 1.9 .05
ShowerHead t .15 .15 .15; SideTable r .5 .6 .45; Sink _ .7 .3 .5; SinkBasin r .5 .2 .4; SoapBar p .08 .03 .05
SoapBottle p .08 .22 .08; Sofa r 2 .85 .9; Spatula p .3 .03 .08; Spoon p .18 .02 .04; SprayBottle p .1 .24 .08
Statue p .18 .28 .14; StoveBurner r .22 .03 .22; StoveKnob t .06 .06 .06; TVStand r 1.4 .5 .4; Television tm .95 .6 .2
TennisRacket p .28 .68 .06; TissueBox p .24 .1 .13; Toaster rtm .3 .2 .2; Toilet ro .45 .8 .65; ToiletPaper p .1 .1 .1
ToiletPaperHanger r .2 .1 .1; ToiletPaperRoll p .1 .1 .1; Tomato ps .09 .09 .09; Towel p .5 .6 .06
TowelHolder r .5 .1 .1; Vase p .14 .3 .14; Watch p .1 .03 .08; WateringCan p .25 .2 .14; Window _ 1.2 1.2 .08
WineBottle p .08 .3 .08
"""


@dataclass(frozen=True)
class Kind:
    """What can be done with objects of a type, and how large one usually is (width, height, depth in metres)."""

    abilities: frozenset[str]
    size: tuple[float, float, float]


def _read(table: str) -> dict[str, Kind]:
    kinds = {}
    for row in table.replace("\n", ";").split(";"):
        if row.strip():
            name, letters, *size = row.split()
            width, height, depth = map(float, size)
            kinds[name] = Kind(frozenset(ABILITIES[c] for c in letters if c != "_"), (width, height, depth))
    return kinds


KINDS: dict[str, Kind] = _read(_TABLE)
UNKNOWN = Kind(frozenset(), (0.2, 0.2, 0.2))
SLICES = {"Apple": 5, "Bread": 6, "Lettuce": 6, "Potato": 5, "Tomato": 6, "Egg": 1}
"""Sliceable type -> pieces that slicing leaves, at least as many as recorded plans name (an egg is cracked)."""

KNIVES = frozenset({"Knife", "ButterKnife"})


def kind(type_name: str) -> Kind:
    """The kind of an object type; something plain of 20 cm for a type that is not in the table."""
    return KINDS.get(type_name, UNKNOWN)


def piece(type_name: str) -> str:
    """What slicing an object of this type leaves: `Apple` -> `AppleSliced`, `Egg` -> `EggCracked`."""
    return "EggCracked" if type_name == "Egg" else f"{type_name}Sliced"
