"""What users rely on stays: names, signatures, attributes, commands; `scripts/make_promises.py` lists them."""

import pytest

from scripts.make_promises import command_lines, python_lines, stored

ADD = "python -m scripts.make_promises writes the lists"


def split(line: str) -> tuple[str, list[str]]:
    """A name and its arguments."""
    name, _, arguments = line.partition("(")
    return name, [each for each in arguments.removesuffix(")").split(", ") if each]


def broken(then: list[str], now: list[str]) -> str | None:
    """Why a call that was right with the arguments `then` may be wrong with `now`."""
    places = [each.rstrip("=") for each in now]
    by_place, starred = True, False
    for i, each in enumerate(then):
        name = each.rstrip("=")
        by_place &= name != "*"
        if name == "*":
            continue
        if name not in places:
            return f"{name} is gone"
        at = places.index(name)
        if by_place and (at != i or "*" in places[:at]):
            return f"{name} has another place"
        if each.endswith("=") and not now[at].endswith("="):
            return f"{name} must be given"
    for each in now:
        starred |= each == "*"
        if (
            not each.startswith("*")
            and not each.endswith("=")
            and each.rstrip("=") not in {x.rstrip("=") for x in then}
        ):
            return f"{each} is new and must be given"
    return None


def test_python() -> None:
    now = dict(map(split, python_lines()))
    then = [split(line) for line in stored("python.txt")]
    assert [name for name, _ in then if name not in now] == []
    assert [f"{name}: {why}" for name, each in then if (why := broken(each, now[name]))] == []
    assert sorted(now.keys() - {name for name, _ in then}) == [], ADD


def limits(line: str) -> tuple[str, float, float]:
    """A command, and how many arguments it takes at least and at most."""
    name, _, counts = line.partition(" takes ")
    low, _, high = counts.partition(" to ")
    return name, float(low), float("inf" if high == "any number" else high)


def test_options_of_commands() -> None:
    now, then = ({line for line in lines if " -" in line} for lines in (command_lines(), stored("commands.txt")))
    assert sorted(then - now) == []
    assert sorted(now - then) == [], ADD


def test_arguments_of_commands() -> None:
    now, then = (
        [limits(line) for line in lines if " takes " in line] for lines in (command_lines(), stored("commands.txt"))
    )
    counts = {name: (low, high) for name, low, high in now}
    for name, low, high in then:
        assert name in counts, f"{name} is gone"
        assert counts[name][0] <= low, name
        assert counts[name][1] >= high, name
    assert counts.keys() == {name for name, _, _ in then}, ADD


@pytest.mark.parametrize(
    ("then", "now", "why"),
    [
        ("f(a, b=)", "f(a, b=, c=)", None),
        ("f(a, b=)", "f(a, b=, *, c=)", None),
        ("f(a, *, b=)", "f(a, b=)", None),
        ("f(a, b=)", "f(b=, a)", "a has another place"),
        ("f(a, b=)", "f(a)", "b is gone"),
        ("f(a, b=)", "f(a, b)", "b must be given"),
        ("f(a)", "f(a, b)", "b is new and must be given"),
        ("f(a, b=)", "f(a, *, b=)", "b has another place"),
    ],
)
def test_what_breaks_a_call(then: str, now: str, why: str | None) -> None:
    assert broken(split(then)[1], split(now)[1]) == why
