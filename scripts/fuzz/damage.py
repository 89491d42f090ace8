"""Damage of files by a random generator: JSON by its structure, tables by their cells, texts by their words, bytes.

The generator may be Hypothesis's (`strategies.randoms`), which then looks for the smallest damage that fails.
"""

from __future__ import annotations

import json
import random
import re
from collections.abc import Iterator
from typing import Any

# None of these is a number of JSON in the range of float64: a file with one in a number's place must be refused.
NO_NUMBERS = ("true", "false", '"1"', "null", "NaN", "Infinity", "-Infinity", "1e999", "1" + "0" * 400, "[1]", "{}")
ODD_NUMBERS = ("0", "-1", "1e308", "-1e308", "1e-308", "5e-324", "-0.0", "9007199254740993", "1e18", "0.1")
ODD_TEXTS = ("<!--<script>", "=1+1", "\x1b[2J", "\ufffe", "$\\frac{", "\ud800", "a" * 100_000, "", "../../x", "\0")
SLOT = "\ue000"


def _places(value: Any, read: bool = True) -> Iterator[tuple[Any, Any, bool]]:
    """Each place of a JSON value as its holder and key, and whether kcal reads what stands there."""
    pairs = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inside in pairs:
        # A summary is derived from the rest of its file: a wrong one counts as missing.
        here = read and key != "summary"
        yield value, key, here
        yield from _places(inside, here)


def damage_json(data: bytes, rng: random.Random) -> tuple[bytes, str, bool]:
    """Change one place of a JSON text; also what was done, and whether the text must now be refused."""
    content = json.loads(data)
    places = list(_places(content))
    if not places:
        raise ValueError("nothing to damage")
    holder, key, read = rng.choice(places)
    old = holder[key]
    number = read and isinstance(old, int | float) and not isinstance(old, bool)
    raw, refused = rng.choice(NO_NUMBERS if rng.random() < 0.5 else ODD_NUMBERS), False
    way = rng.choice(["value", "value", "value", "text", "drop", "repeat", "nest", "twice"])
    if way == "value":
        refused = number and raw in NO_NUMBERS and raw != "null"
    elif way == "text":
        raw = json.dumps(rng.choice(ODD_TEXTS))
        refused = number
    elif way == "nest":
        raw, refused = "[" * 100 + "]" * 100, True
    elif way == "repeat" and isinstance(old, list):
        raw = json.dumps(old + old)
    elif way == "drop":
        del holder[key]
        return json.dumps(content).encode(), f"{way} {key}", False
    elif way == "twice" and isinstance(holder, dict):
        raw, refused = f"{json.dumps(old)}, {json.dumps(key)}: {json.dumps(old)}", True
    holder[key] = SLOT
    text = json.dumps(content, ensure_ascii=False).replace(json.dumps(SLOT, ensure_ascii=False), raw)
    return text.encode("utf-8", "surrogatepass"), f"{way} {key}: {raw[:40]}", refused


def damage_table(data: bytes, rng: random.Random) -> tuple[bytes, str, bool]:
    """Change one cell of a table below its header."""
    lines = [line.split(",") for line in data.decode().splitlines()]
    if not lines:
        raise ValueError("nothing to damage")
    row, column = rng.randrange(len(lines)), rng.randrange(len(lines[0]))
    text = rng.choice([*ODD_TEXTS, *ODD_NUMBERS, "nan", "inf", '"', "1_0", "1;2", "\r", "'"])
    lines[row][column] = text
    refused = row > 0 and column > 0 and text in ("nan", "inf", "1_0", "1;2", "'", *ODD_TEXTS)
    return (
        "\n".join(map(",".join, lines)).encode("utf-8", "surrogatepass"),
        f"cell {row},{column}: {text[:40]}",
        refused,
    )


def damage_bytes(data: bytes, rng: random.Random) -> tuple[bytes, str, bool]:
    """Flip, cut, repeat or overwrite bytes."""
    damaged, way = bytearray(data), rng.choice(["flip", "flip", "cut", "repeat", "fill", "head"])
    at = rng.randrange(64 if way == "head" else len(data))
    if way in ("flip", "head"):
        for _ in range(rng.randint(1, 8)):
            damaged[min(len(data) - 1, at + rng.randrange(8))] ^= 1 << rng.randrange(8)
    elif way == "cut":
        del damaged[at:]
    elif way == "repeat":
        damaged[at:at] = data[at : at + 1000]
    else:
        damaged[at : at + 16] = bytes([rng.choice([0, 255])]) * 16
    return bytes(damaged), f"{way} at {at}", False


_WORD = re.compile(rb"[-+]?[0-9][-+.0-9eE]*|[A-Za-z_]\w*")


def damage_text(data: bytes, rng: random.Random) -> tuple[bytes, str, bool]:
    """Replace a number or a word, or take out, repeat or exchange lines."""
    words = list(_WORD.finditer(data))
    if words and rng.random() < 0.7:
        word = rng.choice(words)
        other = rng.choice(
            [*NO_NUMBERS, *ODD_NUMBERS, *ODD_TEXTS, ".nan", "-.inf", "~", "0x10", "1_0", "1,5", "1e5000"]
        )
        new = rng.choice(words)[0] if rng.random() < 0.3 else other.encode("utf-8", "surrogatepass")
        return data[: word.start()] + new + data[word.end() :], f"{word[0][:20]!r} is {new[:40]!r}", False
    lines = data.split(b"\n")
    first, second = rng.randrange(len(lines)), rng.randrange(len(lines))
    way = rng.choice(["drop", "twice", "exchange"])
    if way == "drop":
        del lines[first]
    elif way == "twice":
        lines.insert(second, lines[first])
    else:
        lines[first], lines[second] = lines[second], lines[first]
    return b"\n".join(lines), f"{way} lines {first}, {second}", False


def damaged(data: bytes, suffix: str, rng: random.Random) -> bytes:
    """One to three damages, by what the suffix says the data are."""
    text = b"\0" not in data
    kinds = {".json": damage_json, ".geojson": damage_json, ".csv": damage_table}
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        data = data or b"0"
        damage = damage_bytes
        if text and rng.random() < 0.85:
            damage = rng.choice([kinds.get(suffix, damage_text), damage_text])
        try:
            data = damage(data, rng)[0]
        except (ValueError, IndexError, RecursionError):  # an earlier damage left no JSON, no table or nothing
            data = damage_bytes(data, rng)[0]
    return data
