"""The Capture room in a real browser: photos taken by the coach, one dropped, on to the mask; another tab is told."""

import numpy as np
import pytest
from helpers.browser_tabs import Watched, needs_chromium, studio
from helpers.clips import Making, views
from PIL import Image

pytestmark = [pytest.mark.slow, needs_chromium, pytest.mark.filterwarnings("ignore::DeprecationWarning")]
SIZE = (240, 320)


def clip(path, seed, count):
    made = Making(SIZE, seed)
    pictures, _ = views(seed, SIZE, count)
    for before, after in zip(pictures, [*pictures[1:], None], strict=True):
        made.hold(before, 1.6)
        if after is not None:
            made.fade(before, after)
    return made.write(path)


def dropped(tab, after="photo /"):
    """Wait until the log says that a photo was dropped, and another one taken since; the strip shows it later."""
    script = "after => new RegExp(`dropped .*${after}`).test(document.querySelector('#capture .log').textContent)"
    tab.page.wait_for_function(script, arg=after)


def capturing(browser, url):
    """A tab that has pressed Start, and its room."""
    tab = Watched(browser, url)
    room = tab.page.locator("#capture")
    room.get_by_role("button", name="Start").click()
    return tab, room


def fits(tab):
    return tab.page.evaluate("document.scrollingElement.scrollWidth <= innerWidth")


def test_photos_are_taken_one_is_dropped_and_the_mask_comes_next(browser, tmp_path):
    source, raw = clip(tmp_path / "a.mp4", 3, 4), tmp_path / "raw"
    with studio(raw, "--source", source) as url:
        tab, other = Watched(browser, url), Watched(browser, url, width=390)
        room = tab.page.locator("#capture")
        room.get_by_text("Set up the camera").wait_for()
        assert room.locator(".group").get_attribute("placeholder") == "group_1" and not raw.exists()
        other.page.locator("#capture .next").get_by_text("Set up the camera").wait_for()
        assert fits(tab) and fits(other)
        named = "e.getAttribute('aria-label') || e.labels?.length || e.textContent.trim()"
        unnamed = f"elements => elements.filter(e => !({named})).length"
        assert room.locator(":is(button, select, input, [tabindex])").evaluate_all(unnamed) == 0
        room.locator(".group").fill("../door")
        room.get_by_role("button", name="Start").click()
        room.locator(".wrong").get_by_text("no separators").wait_for()
        room.locator(".group").fill("door")
        room.locator(".group").press("Enter")
        room.locator(".strip li").first.wait_for()
        other.page.get_by_text("Another tab of this studio takes photos of door").wait_for()
        assert room.locator(".picture").get_attribute("src").startswith("data:image/jpeg;base64,")
        assert room.locator(".picture").evaluate("picture => picture.naturalWidth") == SIZE[1]
        room.locator(".log").get_by_text("the clip ends").wait_for()
        room.locator(".next").get_by_text("4 photos").wait_for()
        assert "changed so far" in room.locator(".log").text_content()
        assert room.locator("[data-figure=drift]").text_content().endswith(" px")
        room.get_by_role("button", name="Drop door/002.png").click()
        room.locator(".next").get_by_text("3 photos").wait_for()
        assert sorted(path.name for path in (raw / "door").iterdir()) == ["001.png", "003.png", "004.png"]
        assert fits(tab) and fits(other)
        room.get_by_role("button", name="Draw the mask").click()
        tab.said("^Click on the mirror")
        assert tab.page.locator("#masks .group").input_value() == "train/door"
        assert tab.page.locator("#masks .strip li").count() == 3
        # Again, now that the Masks room is there already, and while photos are still taken.
        tab.page.get_by_role("tab", name="Capture").click()
        room.locator(".group").fill("")
        room.get_by_role("button", name="Start").click()
        room.get_by_role("button", name="Drop group_1/001.png").click()
        dropped(tab)  # and the next view was taken
        room.get_by_role("button", name="Draw the mask").click()
        tab.page.wait_for_function("document.querySelector('#masks .group').value === 'train/group_1'")
        tab.said("^Click on the mirror")
        for one in (tab, other):
            one.close()
    with Image.open(raw / "door" / "003.png") as photo:
        assert photo.size == SIZE[::-1] and np.asarray(photo).std() > 10


def test_keys_end_it_and_a_closed_tab_stops_the_camera(browser, tmp_path):
    source, raw = clip(tmp_path / "a.mp4", 4, 12), tmp_path / "raw"
    with studio(raw, "--source", source) as url:
        tab, room = capturing(browser, url)
        room.get_by_role("button", name="Drop group_1/001.png").click()  # and the keys are still the room's
        dropped(tab, "")
        tab.page.keyboard.press("p")
        dropped(tab)
        tab.page.keyboard.press("q")
        room.locator(".next").get_by_text("group_1: ").wait_for()
        room.get_by_role("button", name="Start").click()
        room.get_by_role("button", name="Drop group_2/001.png").wait_for()
        tab.close()
        later = Watched(browser, url)
        later.page.locator("#capture .log").get_by_text("the page was closed, and the camera is off").wait_for()
        later.page.locator("#capture .next").get_by_text("group_2: ").wait_for()
        later.close()
    assert 1 <= len(list((raw / "group_2").iterdir())) < 12


def contrast(tab, place):
    """Of a text with what lies behind it (WCAG 2.2, 1.4.3: 4.5 at least)."""
    script = """place => {
        let behind = document.querySelector(place);
        const text = getComputedStyle(behind).color;
        while (getComputedStyle(behind).backgroundColor === "rgba(0, 0, 0, 0)") behind = behind.parentElement;
        return [text, getComputedStyle(behind).backgroundColor].map((color) => color.match(/\\d+/g).slice(0, 3));
    }"""
    colors = np.array(tab.page.evaluate(script, place), float) / 255
    linear = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    light = sorted(linear @ [0.2126, 0.7152, 0.0722])
    return (light[1] + 0.05) / (light[0] + 0.05)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_texts_in_color_can_be_read(browser, tmp_path, scheme):
    source = clip(tmp_path / f"{'a_clip_of_a_long_name' * 5}.mp4", 3, 1)
    with studio(tmp_path / "raw", "--source", source) as url:
        tab = Watched(browser, url, width=390)
        tab.page.emulate_media(color_scheme=scheme)
        tab.page.reload()
        room = tab.page.locator("#capture")
        room.get_by_text("Set up the camera").wait_for()
        box = room.locator(".source").bounding_box()
        assert box["x"] + box["width"] <= 390
        for place in (".next", ".wrong", ".enough dd", ".source"):
            assert contrast(tab, f"#capture {place}") >= 4.5
        room.locator(".next").evaluate("next => next.classList.add('warns')")
        assert contrast(tab, "#capture .next") >= 4.5
        tab.close()


def test_impatient_fingers_and_a_masks_room_that_was_there_before(browser, tmp_path):
    source, raw = clip(tmp_path / "a.mp4", 4, 12), tmp_path / "raw"
    with studio(raw, "--source", source) as url:
        tab, other = Watched(browser, url), Watched(browser, url)
        room = tab.page.locator("#capture")
        tab.page.get_by_role("tab", name="Masks").click()
        tab.said("has no groups yet")
        tab.page.get_by_role("tab", name="Capture").click()
        room.get_by_role("button", name="Start").dblclick()
        room.locator(".strip li").first.wait_for()
        assert not room.locator(".wrong").is_visible()
        for _ in range(20):
            tab.page.keyboard.down("p")  # held: the browser repeats it
        tab.page.keyboard.up("p")
        room.locator(".log").get_by_text("the next still moment is a photo").first.wait_for()
        assert room.locator(".log").get_by_text("the next still moment is a photo").count() == 1
        tab.page.keyboard.press("q")
        room.locator(".next").get_by_text("group_1: ").wait_for()
        assert tab.page.evaluate("document.activeElement.classList.contains('next')")
        other.page.locator("#capture .strip li").first.wait_for()
        room.get_by_role("button", name="Start").click()
        other.page.locator("#capture .next").get_by_text("Another tab of this studio").wait_for()
        assert other.page.locator("#capture .strip li").count() == 0  # of which nothing can be dropped
        room.locator(".strip li").first.wait_for()
        tab.page.keyboard.press("q")
        room.locator(".next").get_by_text("group_2: ").wait_for()
        tab.page.get_by_role("tab", name="Masks").click()
        tab.said("^Click on the mirror|Nothing can be compared")
        assert tab.page.locator("#masks .group option").count() == 2
        for one in (tab, other):
            one.close()


def test_a_studio_that_is_gone_is_told_and_found_again(browser, tmp_path):
    source, raw = clip(tmp_path / "a.mp4", 4, 12), tmp_path / "raw"
    with studio(raw, "--source", source) as url:
        tab, room = capturing(browser, url)
        room.locator(".strip li").first.wait_for()
    room.locator(".next").get_by_text("The studio does not answer: start it again.").wait_for()
    assert not room.locator(".live").is_visible()
    with studio(raw, "--source", source, "--port", url.rsplit(":", 1)[1]):
        room.locator(".next").get_by_text("Set up the camera").wait_for()
        assert room.locator(".group").get_attribute("placeholder") == "group_2"
    tab.page.get_by_role("tab", name="Masks").click()
    tab.said("^The studio does not answer")
    tab.page.close()
