"""The parts of the golden set, by name."""

from support.golden import Part, flights, texts

PARTS: dict[str, Part] = {
    "flights": flights.PART,
    "wire": texts.WIRE_PART,
    "help": texts.HELP_PART,
    "tables": texts.TABLES_PART,
}
