"""The small changes that `mutate` makes: in what is computed, and never in text."""

from __future__ import annotations

import ast
from pathlib import Path

from tests.reliability.mutate.__main__ import (
    EQUIVALENT,
    FOLDERS,
    REPOSITORY,
    Imports,
    drawn_sites,
    files_of_tests,
)
from tests.reliability.mutate.sites import sites_of

SOURCE = '''"""A docstring with 7 and a < b."""
from __future__ import annotations
__all__ = ["f"]
Pair = tuple[int, 2]

@njit(cache=True, parallel=True)
def f(a: dict[str, 3], b=4) -> "list[5]":
    """Not 6 + 6."""
    if a < b or not b:
        raise ValueError("expected 8", 8 + 9)
    print(10)
    for i in range(a, b):
        c = a[i:b] + f"{11 - 1}" + str(min(a, b))
        c += zip(a, b, strict=True)
    é = 0.5
    return a - é
'''


def test_sites_are_what_is_computed() -> None:
    found = {(site.old, site.new) for site in sites_of("a.py", SOURCE.encode())}
    assert found == {
        ("4", "5"), ("4", "3"), ("a < b", "(a <= b)"), ("a < b", "(a > b)"), ("not b", "(b)"),
        ("a < b or not b", "(a < b and (not b))"), ("a", "(a - 1)"), ("b", "(b - 1)"), ("i", "(i + 1)"),
        ("b", "(b + 1)"), ("min", "max"), ("c += zip(a, b, strict=True)", "c -= zip(a, b, strict=True)"),
        ("0.5", "1.0"), ("0.5", "0.25"), ("a - é", "(a + é)"), ("a - é", "None"),
    }  # fmt: skip


def test_a_change_is_made_where_it_says() -> None:
    for site in sites_of("a.py", SOURCE.encode()):
        changed = site.applied(SOURCE.encode())
        assert changed != SOURCE.encode() and ast.parse(changed)
        assert changed.startswith(SOURCE.encode()[: site.start]) and changed.endswith(
            SOURCE.encode()[site.end :]
        )
        assert SOURCE.splitlines()[site.line - 1].count(site.old.split(" ")[0]), site.name


def test_every_site_of_the_repository_can_be_made_and_has_a_name_of_its_own() -> None:
    names = set()
    for folder in FOLDERS:
        for path in (REPOSITORY / folder).rglob("*.py"):
            source = path.read_bytes()
            sites = sites_of(path.relative_to(REPOSITORY).as_posix(), source)
            for site in sites[:: max(len(sites) // 20, 1)]:
                ast.parse(site.applied(source))
            assert len({site.name for site in sites}) == len(sites)
            names |= {site.name for site in sites}
    assert len(names) > 10_000


def test_a_seed_draws_the_same_sites_and_another_one_others() -> None:
    first = [site.name for site in drawn_sites(0)[:60]]
    assert first == [site.name for site in drawn_sites(0)[:60]] and len(set(first)) == 60
    assert len(set(first) & {site.name for site in drawn_sites(1)[:60]}) < 10
    assert {name.split("/")[0] for name in first} == {"player", "exporters", "vfr_bake"}


def test_the_likeliest_tests_come_first() -> None:
    imports = Imports(REPOSITORY)
    own, nearest, *others = files_of_tests(imports, "player/march/march.py")
    assert (own, nearest) == ("player/march/march.py", "tests/player/march/test_march.py")
    assert "tests/numerics/test_rays.py" in others and not any("exporters" in name for name in others)
    assert all(Path(REPOSITORY / name).is_file() for name in others)


def test_what_is_said_to_change_nothing_has_a_reason() -> None:
    import json

    reasons = json.loads(EQUIVALENT.read_text(encoding="utf-8"))
    assert all(len(reason) > 20 for reason in reasons.values())
