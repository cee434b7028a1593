"""The primitive types a definition may name, with every fact the other modules need of them.

One table: the ``struct`` code and size of the encoding, the RIHS01 type id, the range of values.
"""

import msgspec

FLOAT32_MAX = 3.4028234663852886e38


class Primitive(msgspec.Struct, frozen=True):
    """A primitive type.

    Attributes:
        name: its name in a definition.
        code: its ``struct`` format character for decoding.
        size: bytes in the encoding, also its alignment.
        type_id: its id in a RIHS01 type description; an array adds 48.
        low: smallest integer; 0 for floats.
        high: largest integer; 0 for floats.
    """

    name: str
    code: str
    size: int
    type_id: int
    low: int = 0
    high: int = 0

    @property
    def is_float(self) -> bool:
        """True for float32 and float64."""
        return self.code in "fd"

    @property
    def allowed(self) -> str:
        """The values it takes, in words for an error message."""
        if self.name == "bool":
            return "True or False"
        if self.name == "float32":
            return "a number within +-3.4028235e+38, an infinity or NaN"
        if self.name == "float64":
            return "a number, an infinity or NaN"
        return f"an integer {self.low}..{self.high}"


# A .msg `char` counts as uint8 (ROS 2's rosidl), in the encoding and in the type hash alike.
_TABLE = (
    Primitive("int8", "b", 1, 2, -(2**7), 2**7 - 1),
    Primitive("uint8", "B", 1, 3, 0, 2**8 - 1),
    Primitive("char", "B", 1, 3, 0, 2**8 - 1),
    Primitive("int16", "h", 2, 4, -(2**15), 2**15 - 1),
    Primitive("uint16", "H", 2, 5, 0, 2**16 - 1),
    Primitive("int32", "i", 4, 6, -(2**31), 2**31 - 1),
    Primitive("uint32", "I", 4, 7, 0, 2**32 - 1),
    Primitive("int64", "q", 8, 8, -(2**63), 2**63 - 1),
    Primitive("uint64", "Q", 8, 9, 0, 2**64 - 1),
    Primitive("float32", "f", 4, 10),
    Primitive("float64", "d", 8, 11),
    Primitive("bool", "?", 1, 15, 0, 1),
)

PRIMITIVES: dict[str, Primitive] = {primitive.name: primitive for primitive in _TABLE}
