"""Checks of the tests themselves: mutations and chance."""

import ast
from pathlib import Path

import pytest
import torch

from kcal.checks import beyond_chance, chi2_quantile, chi2_tail, variance_factor
from scripts.check.mutants import Draw, first_draw, interval
from scripts.check.mutations import sites

# Planting of mistakes: each kind where it belongs, one at a time, and code that still compiles.


ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("if a < b:\n        pass", {"a >= b"}),
        ("return len(a) > 2", {"len(a) <= 2", "len(a) >= 2", "3"}),
        ("return a and (not b)", {"a or not b", "b"}),
        ("if a.any():\n        pass", {"a.all()", "not a.any()"}),
        ("return a @ b.T", {"b.T @ a", "-(a @ b.T)", "b"}),
        ("return f(a, b) ** 2", {"f(b, a)", "f(a, b) * 2", "-f(a, b) ** 2", "3"}),
        ("return g([a, b, 1.5], dim=-1)", {"[b, a, 1.5]", "2.5", "2"}),
        ("return torch.where(a, b, c)", {"torch.where(a, c, b)"}),
        ("a += b[:n]", {"a -= b[:n]", ":n - 1"}),
        ("return max(a, b), -a", {"min(a, b)", "a", "(-a, max(a, b))"}),
        ("return a in (b, c)", {"a not in (b, c)"}),
        ("raise ValueError(f'{a + 1}: {2 * b}')", set()),
        ("return f(a, dtype=b[0])", set()),
    ],
)
def test_kinds(before: str, after: set[str]) -> None:
    found = sites(ast.parse(f"def f(a: int | str, b, c, n):\n    '''1 + 1'''\n    {before}"), "f.py")
    planted = {site.after.removeprefix("return ") for site in found}
    assert planted == after
    assert {site.function for site in found} <= {"f"}


@pytest.mark.slow
def test_one_at_a_time_wherever_it_is() -> None:
    path = ROOT / "kcal" / "solve" / "lm.py"
    text = path.read_text(encoding="utf-8")
    plain, seen = ast.unparse(ast.parse(text)), set()
    count = len(sites(ast.parse(text), "lm.py"))
    for number in range(0, count, 40):
        tree = ast.parse(text)
        site = sites(tree, "lm.py")[number]
        site.plant()
        changed = ast.unparse(ast.fix_missing_locations(tree))
        compile(tree, "lm.py", "exec")
        lines = [pair for pair in zip(plain.splitlines(), changed.splitlines(), strict=True) if pair[0] != pair[1]]
        assert len(lines) == 1, site
        seen.add(changed)
    assert len(seen) == len(range(0, count, 40))


def test_names_and_keys() -> None:
    code = (
        "class A:\n    x = 1\n    def f(self, y=2):\n        def g():\n            return 3\n        return g() + 4\n"
    )
    found = sites(ast.parse(code), "a.py")
    assert {site.after: site.function for site in found if site.kind == "constant"} == {
        "2": "", "3": "", "4": "A.f.<locals>.g", "5": "A.f",
    }  # fmt: skip
    # Keys belong to a statement of the module: another one before it changes nothing but lines.
    moved = sites(ast.parse(f"import os\nz = 7\n{code}"), "a.py")
    assert {site.key for site in found} < {site.key for site in moved}
    assert not {site.key for site in found} & {site.key for site in sites(ast.parse(code), "b.py")}


def test_interval_of_a_share() -> None:
    assert interval(45, 50) == pytest.approx((0.786, 0.957), abs=1e-3)
    assert interval(10, 10) == pytest.approx((0.722, 1.0), abs=1e-3)


def test_first_draws_stay() -> None:
    """Of the page where it has one, or where its only draw is not among the results; otherwise of the results."""
    one, two = {41: Draw(8, 1, 5)}, {41: Draw(8, 1, 5), 42: Draw(8, 0, 8)}
    for by_seed, row, before in (
        (one, None, ""),
        (two, None, "5 of 7"),
        (one, ("`io`", "", "31", "8", "0", "4 of 8"), "4 of 8"),
        (one, ("`io`", "7 of 17", "15", "5", "0", "2 of 5"), "7 of 17"),
        (one, ("`io`", "7 of 17", "41", "8", "1", "5 of 7"), "7 of 17"),
        (one, ("`io`", "", "41", "8", "1", "5 of 7"), ""),
        (two, ("`io`", "", "41", "8", "1", "5 of 7"), "5 of 7"),
    ):
        assert first_draw(by_seed, row) == before


# The χ² distribution: quantiles against published tables, and what follows from them.


def test_quantiles_are_those_of_the_tables() -> None:
    """NIST/SEMATECH e-Handbook, 1.3.6.7.4, upper critical values: three decimals."""
    freedom = torch.tensor([1, 2, 5, 10, 100])
    table = [10.828, 13.816, 20.515, 29.588, 149.449]
    assert chi2_quantile(freedom, 0.999).tolist() == pytest.approx(table, abs=6e-4)
    assert chi2_tail(torch.tensor(table), freedom).tolist() == pytest.approx([0.001] * 5, rel=5e-4)
    assert [float(chi2_tail(*none)) for none in ((-1e-12, 3), (5.0, 0))] == [1.0, 1.0]
    assert chi2_quantile(freedom, 0.9).tolist() == pytest.approx([2.706, 4.605, 9.236, 15.987, 118.498], abs=6e-4)


def test_shapes_and_no_freedom() -> None:
    assert chi2_quantile(torch.zeros(2, 3), 0.9).tolist() == [[0.0] * 3] * 2
    assert chi2_quantile(4.0, 0.9).shape == ()
    assert chi2_quantile(torch.empty(0), 0.9).shape == (0,)
    between = [float(chi2_quantile(freedom, 0.9)) for freedom in (2, 2.5, 3)]
    assert between == sorted(between)


def test_what_chance_explains() -> None:
    assert not beyond_chance(29.5, 10)
    assert beyond_chance(29.6, 10)
    assert not beyond_chance(29.6, 0)
    assert variance_factor(29.5, 10) == 1.0
    assert variance_factor(29.6, 10) == pytest.approx(2.96)
    assert variance_factor(5.0, 0) == 1.0
