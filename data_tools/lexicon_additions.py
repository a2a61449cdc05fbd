"""What the lexicon of indoor nouns changes in WordNet; senses are given by WordNet's sense keys."""

from __future__ import annotations

# The meanings of nouns whose most frequent meaning is not the indoor one. Others are dropped.
INDOOR_SENSES = {
    "appliance": "appliance%1:06:01 appliance%1:06:00",
    "bean bag": "beanbag%1:06:00",
    "bench": "bench%1:06:00",
    "bike": "bicycle%1:06:00",
    "book": "book%1:06:00",
    "can": "can%1:06:00",
    "counter": "counter%1:06:00 sideboard%1:06:00",
    "comforter": "comforter%1:06:00",
    "cushion": "cushion%1:06:00",
    "dresser": "dresser%1:06:00 dresser%1:06:02",
    "human": "person%1:03:00",
    "keyboard": "keyboard%1:06:01",
    "light": "light%1:06:00",
    "man": "man%1:18:00",
    "monitor": "monitor%1:06:02",
    "mouse": "mouse%1:06:00",
    "mug": "mug%1:06:00",
    "newspaper": "newspaper%1:06:00",
    "notebook": "notebook%1:06:00",
    "paper": "paper%1:27:00 paper%1:06:00",
    "people": "person%1:03:00",
    "person": "person%1:03:00",
    "phone": "telephone%1:06:00",
    "plant": "plant%1:03:00",
    "plate": "plate%1:06:00",
    "pot": "pot%1:06:00 pot%1:06:04",
    "printer": "printer%1:06:00",
    "rack": "rack%1:06:01 rack%1:06:00",
    "seat": "seat%1:06:01",
    "screen": "screen%1:06:05 screen%1:06:03",
    "speaker": "loudspeaker%1:06:00",
    "stair": "stairway%1:06:00",
    "stand": "stand%1:06:03 stand%1:06:04",
    "stool": "stool%1:06:00",
    "tablet": "",
    "television": "television_receiver%1:06:00",
    "toilet": "toilet%1:06:01",
    "tv": "television_receiver%1:06:00",
    "vent": "vent%1:06:00",
    "woman": "woman%1:18:00",
}

# Further names of meanings.
SYNONYMS = {
    "bathroom tissue": "toilet_tissue%1:27:00",
    "carpeted floor": "rug%1:06:00",
    "couch bed": "sofa_bed%1:06:00",
    "dustbin": "ashcan%1:06:00",
    "electronics": "electronic_equipment%1:06:00",
    "fridge": "refrigerator%1:06:00",
    "garbage bin": "ashcan%1:06:00",
    "headphones": "earphone%1:06:00",
    "headset": "earphone%1:06:00",
    "human": "person%1:03:00",
    "indoor plant": "houseplant%1:20:00",
    "lighting": "light%1:06:00",
    "mobile": "cellphone%1:06:00",
    "people": "person%1:03:00",
    "power outlet": "wall_socket%1:06:00",
    "power socket": "wall_socket%1:06:00",
    "refridgerator": "refrigerator%1:06:00",  # NYU40's spelling
    "rubbish bin": "ashcan%1:06:00",
    "set of clothing": "clothing%1:06:00",
    "shelving": "shelf%1:06:00",
    "smartphone": "cellphone%1:06:00",
    "stair": "stairway%1:06:00",
    "steps": "stairway%1:06:00",
    "trash bin": "ashcan%1:06:00",
    "tv monitor": "television_receiver%1:06:00",
    "tv screen": "television_receiver%1:06:00",
    "wc": "toilet%1:06:01",
    "wall outlet": "wall_socket%1:06:00",
    "waste bin": "ashcan%1:06:00",
}

# Further kinds: the first meaning is a kind of the second.
KINDS = {
    "beanbag%1:06:00": "seat%1:06:01",
    "bookcase%1:06:00": "bookshelf%1:06:00",
    "cellphone%1:06:00": "telephone%1:06:00",
    "cupboard%1:06:00": "cabinet%1:06:00",
    "lamp%1:06:00": "light%1:06:00",
    "lamp%1:06:01": "light%1:06:00",
    "monitor%1:06:02": "screen%1:06:05",
    "mug%1:06:00": "cup%1:06:00",
    "photograph%1:06:00": "picture%1:06:00",
    "pot_plant%1:20:00": "houseplant%1:20:00",
    "stairs%1:06:00": "stairway%1:06:00",
    "television_receiver%1:06:00": "screen%1:06:05",
    "wastepaper_basket%1:06:00": "bin%1:06:00",
}

# Meanings that WordNet lacks, or has among texts and persons: names, and what they are a kind of.
NEW: tuple[tuple[tuple[str, ...], tuple[str, ...]], ...] = (
    (("nightstand", "bedside table", "night table"), ("table%1:06:01",)),
    (("cooktop", "stovetop", "hob"), ("kitchen_appliance%1:06:00",)),
    (("poster", "print"), ("picture%1:06:00",)),
    (("tablet", "tablet computer"), ("portable_computer%1:06:00",)),
    (("table runner",), ("table_linen%1:06:00",)),
    (("tv stand", "media console"), ("furniture%1:06:00",)),
    (("whiteboard", "dry erase board"), ("board%1:06:00",)),
)

# Persons of the lexicon; WordNet's others are occupations and insults.
PERSONS = (
    "adult%1:18:00 baby%1:18:00 boy%1:18:00 child%1:18:00 girl%1:18:00 man%1:18:00 "
    "teenager%1:18:00 woman%1:18:00"
)
