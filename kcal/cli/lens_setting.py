"""How the setting of a lens is typed: NAME=NUMBER, of several cameras NAME=NUMBER,NUMBER,..."""

from __future__ import annotations

from kcal.errors import InputError


def option_number(text: str, option: str) -> float:
    """A number that is part of an option."""
    try:
        return float(text)
    except ValueError:
        raise InputError(f"{option}: {text.strip()!r} is not a number") from None


def named_numbers(texts: list[str] | None, option: str) -> dict[str, list[float]]:
    """Parse NAME=NUMBER[,NUMBER...] of an option that may be repeated."""
    found: dict[str, list[float]] = {}
    for text in texts or []:
        name, equals, values = (part.strip() for part in text.partition("="))
        if not name or not equals:
            raise InputError(f"{option} {text}: write NAME=NUMBER, for example focus=3.2")
        if name in found:
            raise InputError(f"{option} {text}: {name} is stated twice")
        found[name] = [option_number(value, f"{option} {text}") for value in values.split(",")]
    return found


def stated_settings(texts: list[str] | None, count: int) -> list[dict[str, float]]:
    """The setting of each of some cameras, by `--setting`; empty if not given."""
    found = named_numbers(texts, "--setting")
    for name, values in found.items():
        if len(values) not in (1, count):
            raise InputError(f"--setting {name}: {len(values)} numbers for {count} cameras; give one, or one for each")
    return [{name: values[i % len(values)] for name, values in found.items()} for i in range(count)]
