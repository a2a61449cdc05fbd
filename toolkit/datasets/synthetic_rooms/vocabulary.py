"""Class names and ids of Replica, which are also used for synthetic rooms."""

from __future__ import annotations

from collections.abc import Sequence

# In the order of Replica's ids, which start at 1; 0 is void.
_NAMES = """
backpack base-cabinet basket bathtub beam beanbag bed bench bike bin blanket blinds book
bottle box bowl camera cabinet candle chair chopping-board clock cloth clothing coaster
comforter computer-keyboard cup cushion curtain ceiling cooktop countertop desk
desk-organizer desktop-computer door exercise-ball faucet floor handbag hair-dryer handrail
indoor-plant knife-block kitchen-utensil lamp laptop major-appliance mat microwave monitor
mouse nightstand pan panel paper-towel phone picture pillar pillow pipe plant-stand plate
pot rack refrigerator remote-control scarf sculpture shelf shoe shower-stall sink
small-appliance sofa stair stool switch table table-runner tablet tissue-paper toilet
toothbrush towel tv-screen tv-stand umbrella utensil-holder vase vent wall wall-cabinet
wall-plug wardrobe window rug logo bag set-of-clothing
"""
CLASS_NAMES: tuple[str, ...] = tuple(_NAMES.split())
# Replica has no class for mirrors; glossy rooms add one behind the others.
MIRROR = "mirror"
GLOSSY_CLASS_NAMES: tuple[str, ...] = (*CLASS_NAMES, MIRROR)


def numbered(names: Sequence[str]) -> dict[str, int]:
    """Return class ids by name, from 1."""
    return {name: number for number, name in enumerate(names, start=1)}


CLASS_IDS: dict[str, int] = numbered(CLASS_NAMES)
