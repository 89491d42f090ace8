"""The marking page in a real browser: windows on the same marks, clicks beside the picture, what is said and when."""

import itertools
from collections.abc import Iterator
from typing import Any

import pytest
from browser import chromium_page, needs_browser, violations

pytest.importorskip("uvicorn", reason="the extra `mark` is not installed")
from marking_browser import choose, click_at, look_at, settled
from pages import desk_of, served

from kcal.errors import FileError
from kcal.mark.items import Mark, Put
from kcal.mark.marking_service import Desk
from kcal.mark.server import marking_app
from scripts.shared.marking_scene import LANDMARKS, MarkingSite

pytestmark = needs_browser
STATUS = "document.getElementById('status').textContent"
NO_POSE = "no relative pose yet"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Desk, MarkingSite, str]]:
    folder = tmp_path_factory.mktemp("site")
    with desk_of(folder) as (desk, scene), served(lambda token, hosts: marking_app(desk, token, hosts)) as address:
        yield desk, scene, address


def opened(page: Any, address: str) -> None:
    page.goto(address)
    settled(page)


def mark(page: Any, scene: MarkingSite, name: str, *sides: int) -> None:
    choose(page, name)
    for number in sides:
        side = ("left", "right")[number]
        u, v = map(float, scene.pixels[name][number])
        look_at(page, side, u, v)
        click_at(page, side, u, v)
        page.wait_for_function("([name, side]) => kcal.item(name)[side]", arg=[name, side])


@pytest.mark.slow
def test_windows_on_the_same_marks_follow_each_other(site: tuple[Desk, MarkingSite, str]) -> None:
    _, scene, address = site
    with chromium_page() as first:
        opened(first, address)
        second = first.context.new_page()
        opened(second, address)
        mark(first, scene, "post 1", 0)
        second.wait_for_function("() => kcal.item('post 1').left")
        assert second.evaluate(STATUS) == "another window changed the marks"
        second.evaluate("kcal.act({do: 'undo'})")
        first.wait_for_function("() => !kcal.item('post 1').left")
        # Neither takes from the other what it has not sent yet.
        first.evaluate("kcal.actions.sending = true; kcal.act({do: 'add', name: 'one', kind: 'target'}); 0")
        second.evaluate("kcal.actions.sending = true; kcal.act({do: 'add', name: 'two', kind: 'target'}); 0")
        second.wait_for_function(
            "() => Object.keys(localStorage).filter((name) => name.startsWith('kcal-unsent:')).length === 2"
        )
        first.close()
        second.reload()
        settled(second)
        second.wait_for_function("() => kcal.item('one') && kcal.item('two')")
        for name in ("one", "two"):
            second.evaluate("name => kcal.act({do: 'drop', name})", name)
        settled(second)


def test_a_click_beside_the_picture_marks_nothing(site: tuple[Desk, MarkingSite, str]) -> None:
    desk, _, address = site
    with chromium_page() as page:
        opened(page, address)
        choose(page, "post 2")
        look_at(page, "left", 0, 0, 6.0)
        before = desk.session.version
        click_at(page, "left", -8.0, 5.0)
        page.wait_for_function(f"() => {STATUS}.includes('outside the picture')")
        # Had it been sent all the same, it would have been before this one.
        page.evaluate("kcal.act({do: 'drop', name: 'nobody'})")
        settled(page)
        assert desk.session.version == before
        # A drag beyond the border springs back.
        page.evaluate("kcal.place('left', 2, 2, false)")
        page.wait_for_function("() => kcal.item('post 2').left")
        page.evaluate("kcal.drag('left', kcal.item().left, -30, 0); kcal.drop()")
        settled(page)
        assert page.evaluate("kcal.item('post 2').left.u") == 2
        page.evaluate("kcal.act({do: 'take', name: 'post 2', side: 'left'})")
        settled(page)


@pytest.mark.slow
def test_a_refusal_ends_with_its_reason(site: tuple[Desk, MarkingSite, str]) -> None:
    """Without a rig there is no proposal; the fourth landmark gives one, and the fifth begins without that sentence."""
    _, scene, address = site
    with chromium_page() as page:
        opened(page, address)
        for point in LANDMARKS[:3]:
            mark(page, scene, point.name, 0, 1)
        choose(page, LANDMARKS[3].name)
        mark(page, scene, LANDMARKS[3].name, 0)
        page.wait_for_function(f"() => {STATUS}.includes('{NO_POSE}')")
        mark(page, scene, LANDMARKS[3].name, 1)
        page.wait_for_function("() => kcal.rig.known")
        settled(page)
        assert NO_POSE not in page.evaluate(STATUS)
        choose(page, LANDMARKS[4].name)
        assert NO_POSE not in page.evaluate(STATUS)
        mark(page, scene, LANDMARKS[4].name, 0)
        page.wait_for_function("() => document.documentElement.dataset.proposal === 'there'")
        assert page.is_enabled("#accept")
        page.click("#accept")
        page.wait_for_function("name => kcal.item(name).right", arg=LANDMARKS[4].name)
        assert not page.is_enabled("#accept")


SIZES = [(1280, 800), (390, 800)]
BOXES = (
    "() => [...document.querySelectorAll('header button, header label')].filter((e) => !e.hidden)"
    ".map((e) => [e.id, ...Object.values(e.getBoundingClientRect().toJSON())])"
)


@pytest.mark.slow
def test_letters_of_a_name_are_no_keys(site: tuple[Desk, MarkingSite, str]) -> None:
    desk, scene, address = site
    with chromium_page() as page:
        opened(page, address)
        mark(page, scene, "post 10", 0)
        settled(page)
        before = desk.session.version
        page.keyboard.press("n")
        page.keyboard.type("buoy")  # U would undo, and N begin another
        assert desk.session.version == before
        assert page.evaluate("document.activeElement.id") == "new-name"
        assert violations(page) == []
        page.keyboard.press("Enter")
        page.wait_for_function("() => kcal.selected === 'buoy'")
        settled(page)
        assert page.evaluate("kcal.item('post 10').left") is not None
        # A name that is there already is chosen; without a name it gets a number; Escape adds nothing.
        for typed, chosen in (("post 11", "post 11"), ("", "target 1")):
            page.keyboard.press("n")
            page.keyboard.type(typed)
            page.keyboard.press("Enter")
            page.wait_for_function("name => kcal.selected === name", arg=chosen)
        page.keyboard.press("n")
        page.keyboard.press("Escape")
        settled(page)
        assert desk.session.version == before + 2
        for action in ("{do: 'drop', name: 'buoy'}", "{do: 'drop', name: 'target 1'}"):
            page.evaluate(f"kcal.act({action})")
        settled(page)


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_nothing_moves_and_nothing_is_covered(site: tuple[Desk, MarkingSite, str], width: int, height: int) -> None:
    """Buttons stay where they are when a proposal comes; the foot is below all; landscape pictures fill their pane."""
    _, _, address = site
    with chromium_page(width, height) as page:
        opened(page, address)
        before = page.evaluate(BOXES)
        page.evaluate(
            "kcal.proposed('right', {refusal: '', u: 90, v: 90, cov: [1, 0, 1], how: 'match', sigma: 1, score: 1})"
        )
        page.wait_for_function("() => !document.getElementById('accept').disabled")
        assert page.evaluate(BOXES) == before
        page.evaluate("kcal.reject()")
        main, foot = (page.locator(name).bounding_box() for name in ("main", "#foot"))
        assert main["y"] + main["height"] <= foot["y"] + 0.5
        assert foot["y"] + foot["height"] <= height
        page.evaluate("kcal.views.left.fit()")
        shown, (wide, _) = page.evaluate("[kcal.zoomed('left'), kcal.about.images.left.size]")
        # Side by side on the wide screen, they would be 469 px wide.
        assert shown * wide >= (width - 20 if width < 800 else 600)
        assert page.evaluate("document.documentElement.scrollWidth") <= width


@pytest.mark.slow
def test_marks_of_landmarks_are_removed_by_a_button(site: tuple[Desk, MarkingSite, str]) -> None:
    _, scene, address = site
    with chromium_page() as page:
        opened(page, address)
        mark(page, scene, "post 12", 0, 1)
        settled(page)
        page.click("#take-right")
        page.wait_for_function("() => !kcal.item('post 12').right && kcal.item('post 12').left")
        # What was removed is proposed again, as after any mark.
        page.wait_for_function("() => kcal.proposals.right")
        assert not page.is_enabled("#take-right")
        page.click("#take-left")
        page.wait_for_function("() => !kcal.item('post 12').left")
        assert not page.is_enabled("#take-left")


@pytest.mark.slow
def test_a_click_from_afar_says_what_it_is_worth(site: tuple[Desk, MarkingSite, str]) -> None:
    _, scene, address = site
    u, v = map(float, scene.pixels["post 12"][0])
    with chromium_page() as page:
        opened(page, address)
        choose(page, "post 12")
        look_at(page, "left", u, v, 0.25)
        click_at(page, "left", u, v)
        page.wait_for_function("() => kcal.item('post 12').left")
        assert page.evaluate("kcal.item('post 12').left.sigma") == pytest.approx(4.0)
        page.wait_for_function(f"() => {STATUS}.includes('σ 4.0 px, one pixel of the screen at 0.25×')")
        page.keyboard.press("z")
        page.keyboard.press("s")
        page.wait_for_function("() => kcal.item('post 12').left.sigma < 0.3")
        page.click("#take-left")
        page.wait_for_function("() => !kcal.item('post 12').left")


SPREAD = """() => {
  const left = (i) => ({u: 400 + 40 * (i % 6), v: 300 + 25 * Math.floor(i / 6), cov: [1, 0, 1], how: 'hand', sigma: 1});
  kcal.items = Array.from({length: 30}, (_, i) => ({name: 'thing ' + i, kind: 'feature', left: left(i)}));
  kcal.items.push({name: 'chosen', kind: 'feature', left: {...left(0), u: 200, v: 150}});
  kcal.selected = 'chosen';
  const view = kcal.views.left, c = view.context, fill = c.fillText, names = [];
  c.fillText = function (words, x, y) {
    names.push([x, y - 11, x + c.measureText(words).width, y + 3]);
    fill.apply(c, arguments);
  };
  view.paint();
  const marks = kcal.items.map((item) => view.screen(item.left.u, item.left.v));
  const [x, y] = marks.pop(), cross = [[x - 26, y - 1, x + 26, y + 1], [x - 1, y - 26, x + 1, y + 26]];
  return [names, [...cross, ...marks.map(([x, y]) => [x - 7, y - 7, x + 7, y + 7])]];
}"""


@pytest.mark.slow
def test_names_stand_beside_marks(site: tuple[Desk, MarkingSite, str]) -> None:
    """As drawn: no name on a mark, none on another name."""
    _, _, address = site
    with chromium_page() as page:
        opened(page, address)
        names, marks = page.evaluate(SPREAD)
    assert 5 <= len(names) < 31
    for a, b in [*itertools.combinations(names, 2), *itertools.product(names, marks)]:
        assert min(a[2], b[2]) - max(a[0], b[0]) <= 0.5 or min(a[3], b[3]) - max(a[1], b[1]) <= 0.5


@pytest.mark.slow
def test_a_full_disk_is_on_the_page(site: tuple[Desk, MarkingSite, str], monkeypatch: pytest.MonkeyPatch) -> None:
    """The mark waits on the page and is sent again; tables that could not be written are told in words."""
    desk, _, address = site

    def full(*_: object) -> None:
        raise FileError("marks.log: cannot write: the disk is full; this was not done") from OSError(28, "no space")

    with chromium_page() as page:
        opened(page, address)
        choose(page, "post 9")
        with monkeypatch.context() as patched:
            patched.setattr(desk.session._journal, "do", full)
            page.evaluate("kcal.place('left', 100, 100, false); 0")
            page.wait_for_function(f"() => {STATUS}.includes('the disk is full') && {STATUS}.includes('1 unsent')")
            assert page.evaluate("kcal.item('post 9').left") is None
        page.wait_for_function("() => kcal.item('post 9').left")
        # A proposal for the other side, or why there is none, may be said by now.
        assert "the disk is full" not in page.evaluate(STATUS)
        with monkeypatch.context() as patched:
            patched.setattr("kcal.mark.session.write_atomic", full)
            page.evaluate("kcal.place('right', 100, 100, false); 0")
            page.wait_for_function("() => !document.getElementById('trouble').hidden")
            assert "Nothing is lost" in page.inner_text("#trouble")
            assert violations(page) == []
        page.evaluate("kcal.act({do: 'undo'})")
        page.wait_for_function("() => document.getElementById('trouble').hidden")
    mark = Mark(u=1.0, v=1.0, cov=(0.01, 0.0, 0.01), frame=desk.pictures.names[0])
    desk.act(Put(do="put", name="post 9", side="left", mark=mark), "key-at-the-end")
