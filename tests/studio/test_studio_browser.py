"""The studio in a real browser: a scripted user, two tabs, the keyboard alone, a telephone's width, crafted requests.

Nothing is asked of any other address, and the browser has nothing to complain about.
"""

import json
import re
import shutil
import time
import urllib.error
import urllib.request

import cv2
import numpy as np
import pytest
from helpers.browser_tabs import Watched, needs_chromium, studio
from helpers.exports import write_adapter
from helpers.photos import capture, motion
from helpers.tiny import SIZE, tiny_model, tiny_processor, write_raw_tree
from PIL import Image

from gift_peft.dataset.proxies import SurfaceSettings
from gift_peft.prepare.prepare import prepare_gift_i
from gift_peft.prepare.settings import PrepareSettings
from gift_peft.studio.group_view import look_at
from gift_peft.studio.server import PAGE
from gift_peft.training.teacher import make_proxies

pytestmark = [
    pytest.mark.slow,
    needs_chromium,
    pytest.mark.filterwarnings("ignore:the base is the local folder", "ignore::DeprecationWarning"),
]
PHOTOS = 10


def middle(mask):
    """The place, in shares, of the pixel farthest from a region's border."""
    depth = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    y, x = np.unravel_index(int(depth.argmax()), depth.shape)
    return (x + 0.5) / mask.shape[1], (y + 0.5) / mask.shape[0]


def largest(mask):
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    return labels == 1 + stats[1:, cv2.CC_STAT_AREA].argmax() if count > 1 else mask


def iou(found, mask):
    return (found & mask).sum() / (found | mask).sum()


def group(tmp_path, seed):
    """(RAW of a group of ten photos, three of which a moved camera took, and their true masks)."""
    rng, size = np.random.default_rng(seed), (300, 400)
    folder = capture(
        tmp_path / "raw" / "hall", seed, PHOTOS, size, motions=[motion(rng, size, 4, 0.2, 0) for _ in range(3)]
    )
    masks = [np.asarray(Image.open(folder / "masks" / f"{index}.png")) > 0 for index in range(PHOTOS)]
    shutil.rmtree(folder / "masks")
    return tmp_path / "raw", masks


@pytest.mark.parametrize("seed", [21, 22])
def test_a_user_makes_the_masks_of_ten_photos(browser, tmp_path, seed):
    """At most 8 pointer actions; the masks of all photos, carried as `prepare` does it, overlap by 0.95 and more."""
    root, masks = group(tmp_path, seed)
    truth, file = masks[-1], root / "hall" / "mask.png"
    with studio(root) as url:
        tab = Watched(browser, url)
        tab.said("^Click")
        assert tab.page.locator("#masks .strip li").count() == PHOTOS
        place, key, actions = middle(truth), "1", 0
        for _ in range(8):
            tab.page.keyboard.press(key) if actions else None
            tab.click(place)
            actions += 1
            tab.said("not saved")
            tab.page.keyboard.press("s")
            tab.said(r"^Saved: hall/mask\.png\.$")
            found = np.asarray(Image.open(file)) > 0
            if iou(found, truth) >= 0.96:
                break
            lacking, beside = largest(truth & ~found), largest(found & ~truth)
            key, region = ("1", lacking) if lacking.sum() > beside.sum() else ("2", beside)
            place = middle(region)
        tab.close()
    assert actions <= 8
    view = look_at(root / "hall", "train", root, tmp_path / "own", None, lambda said: None)
    assert [told["status"] for told in view.told].count("dropped") == 0
    overlaps = [iou(view.carried(found, index), mask) for index, mask in enumerate(masks)]
    assert min(overlaps) >= 0.95, overlaps
    report = prepare_gift_i(root, tmp_path / "out", PrepareSettings())
    assert report["groups"][0]["status"] == "kept"


def test_tabs_reloads_and_the_keyboard_alone(browser, tmp_path):
    root, masks = group(tmp_path, 23)
    file, truth = root / "hall" / "mask.png", masks[-1]
    with studio(root) as url:
        first, second = Watched(browser, url), Watched(browser, url, width=390)
        for tab in (first, second):
            tab.said("^Click")
            assert tab.page.evaluate("document.scrollingElement.scrollWidth <= innerWidth")
            named = "e.getAttribute('aria-label') || e.labels?.length || e.textContent.trim()"
            unnamed = f"elements => elements.filter(e => !({named})).length"
            assert tab.page.locator("#masks :is(button, select, input, canvas)").evaluate_all(unnamed) == 0
        first.click(middle(truth))
        first.said("not saved")
        first.page.reload()
        first.said("not saved")  # what was not saved yet is there again
        first.page.keyboard.press("Tab")
        first.page.locator("#masks canvas").focus()
        first.page.keyboard.press("s")
        first.said(r"^Saved: hall/mask\.png\.$")
        kept = file.read_bytes()
        second.page.locator("#masks [data-tool=polygon]").click()
        for place in ((0.1, 0.1), (0.3, 0.1), (0.2, 0.3)):
            second.click(place)
        second.page.keyboard.press("Enter")
        second.said("not saved")
        second.page.locator("#masks [data-do=save]").click()
        second.said("changed since it was loaded")
        assert file.read_bytes() == kept
        second.page.get_by_role("button", name="Load what is saved").click()
        second.said("for all photos")
        # Without a pointer: an eraser at the cross, in the middle of the photo, then undone and saved.
        canvas = second.page.locator("#masks canvas")
        canvas.focus()
        for key in ("3", *"]]]]]]]]", "ArrowRight", "Shift+ArrowDown", "Space"):
            second.page.keyboard.press(key)
        drawn = second.said("not saved")
        second.page.keyboard.press("u")
        second.page.wait_for_function("said => document.querySelector('#masks .said').textContent !== said", arg=drawn)
        second.page.keyboard.press("Space")
        second.said(re.escape(drawn))
        second.page.keyboard.press("Control+s")
        second.said(r"^Saved: hall/mask\.png\.$")
        assert iou(np.asarray(Image.open(file)) > 0, truth) > 0.6 and file.read_bytes() != kept
        second.page.keyboard.press("b")  # blinks
        shown = {second.page.locator("#masks .photo").get_attribute("alt") for _ in range(40) if not time.sleep(0.1)}
        assert len(shown) > 1
        first.page.reload()
        first.said("^Click")
        first.page.locator("#masks .for").select_option("3.png")
        first.said("for 3.png alone")
        first.page.locator("#masks canvas").focus()
        first.page.keyboard.press("x")
        first.said("not saved")
        first.page.keyboard.press("s")
        first.said(r"^Saved: hall/masks/3\.png")
        for tab in (first, second):
            tab.close()
    assert not np.asarray(Image.open(root / "hall" / "masks" / "3.png")).any()


def ask(url, path, headers=(), data=None):
    """(status, body)"""
    request = urllib.request.Request(f"{url}{path}", data, dict(headers))
    try:
        with urllib.request.urlopen(request, timeout=60) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        return error.code, error.read()


def test_crafted_requests_are_refused(tmp_path):
    root, _ = group(tmp_path, 24)
    secret = tmp_path / "secret.txt"
    secret.write_text("a secret")
    with studio(root) as url:
        assert ask(url, "/")[0] == 200
        for path in (
            f"file={secret}",
            f"file={root}/hall/0.png",
            "file=../../secret.txt",
            "file=http://127.0.0.1:1/a",
        ):
            code, body = ask(url, f"/gradio_api/{path}")
            assert code == 403 and b"secret" not in body, path
        for path in (
            "/../secret.txt",
            "/static/../../../secret.txt",
            "/assets/%2e%2e/%2e%2e/secret.txt",
            "/docs",
            "/monitoring",
        ):
            code, body = ask(url, path)
            assert code in (403, 404) and b"a secret" not in body, path
        config = json.loads(ask(url, "/config")[1])
        (masks,) = [one["id"] for one in config["components"] if one["props"].get("elem_id") == "masks"]
        call = {"session_hash": "a", "component_id": masks, "fn_name": "open", "data": {"group": "train/hall"}}
        json_headers = {"content-type": "application/json"}

        def component(headers=json_headers, **changes):
            code, body = ask(url, "/gradio_api/component_server/", headers, json.dumps(call | changes).encode())
            return code, body.decode()

        assert component()[0] == 200
        for name in ("train/../../secret", "../..", str(tmp_path), "/etc", None, {}, ["train/hall"]):
            code, body = component(data={"group": name, "photo": "../../secret.txt"})
            assert code == 200 and json.loads(body).keys() == {"error"} and "there is no group" in body
        code, body = component(
            fn_name="save", data={"group": "train/hall", "photo": "../../x.png", "edits": [], "version": ""}
        )
        assert "there is no photo" in body
        assert json.loads(component(data="train/hall")[1]).keys() == {"error"}
        for name in ("__init__", "get_config", "preprocess", "../open"):
            assert component(fn_name=name)[0] == 404
        for origin in ("http://evil.example", "null", "http://127.0.0.1:1"):
            assert component(json_headers | {"origin": origin})[0] == 403
        assert component(json_headers | {"host": "evil.example"})[0] == 403
        open_tab = urllib.request.urlopen(f"{url}/gradio_api/heartbeat/a", timeout=60)  # does not keep it from ending
    open_tab.close()
    there = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()}
    assert there == {"secret.txt", *(f"raw/hall/{index}.png" for index in range(PHOTOS))}


def test_targets_and_comparison(browser, tmp_path, fresh_cache):
    adapter = write_adapter(tmp_path, tiny_model(), tiny_processor(), SIZE)
    raw = write_raw_tree(tmp_path / "raw", train=(2,), validation=())
    (raw / "train" / "scene_0" / "group.yaml").write_text("static_rig: true\n")
    prepare_gift_i(raw, tmp_path / "gift-i")
    make_proxies(tmp_path / "base", tmp_path / "gift-i", size=SIZE, surface=SurfaceSettings(fills=0))
    with studio(tmp_path / "gift-i", "--adapter", adapter) as url:
        for width in (1280, 390):
            tab = Watched(browser, url, width)
            tab.page.locator("#maps figure").nth(3).wait_for()
            assert tab.page.locator("#maps figcaption").all_text_contents()[1:] == [
                "the base",
                "surface target",
                "their difference",
            ]
            assert tab.page.evaluate("document.scrollingElement.scrollWidth <= innerWidth")
            tab.page.get_by_role("tab", name="Masks").click()
            tab.page.get_by_text("Masks are drawn on a raw tree").wait_for()
            tab.page.get_by_role("tab", name="Compare").click()
            tab.page.locator("#photo input[type=file]").set_input_files(str(raw / "train" / "scene_0" / "1.png"))
            tab.page.get_by_text("adapter at 1.00").wait_for()
            number = tab.page.locator("#scale input[type=number]")
            number.fill("0")
            number.press("Enter")
            tab.page.get_by_text("adapter at 0.00: on average 0.0% from the base").wait_for()
            assert tab.page.locator("#depths img").count() >= 2
            tab.page.locator("#points canvas").wait_for()
            assert tab.page.evaluate("document.scrollingElement.scrollWidth <= innerWidth")
            tab.close()


FAKE = """
window.element = document.body;
window.saves = [];
window.waiting = [];
const uri = "data:image/gif;base64,R0lGODlhAQABAIAAAAAAAP///yH5BAEAAAAALAAAAAABAAEAAAIBRAA7";
const state = (group, photo = "") => ({ place: `${group}/${photo}`, version: "0", overlay: uri });
const later = (answer) => new Promise((resolve) => window.waiting.push(() => resolve(answer)));
window.server = {
  groups: async () => ({ groups: ["a", "b"].map((name) => ({ name, state: "", done: false })) }),
  progress: async () => ({ said: "" }),
  open: async ({ group }) => ({ ...state(group), name: group, size: [40, 30], verdict: [], compares: true, heat: uri,
    photos: [{ name: "1.png", says: "", texts: [], status: "kept", picture: uri, own: false }] }),
  photo: async () => ({ picture: uri }),
  start: ({ group, photo }) => window.slow ? later(state(group, photo)) : Promise.resolve(state(group, photo)),
  draw: async ({ edits }) => ({ overlay: uri, area: edits.length / 100, still: false }),
  save: (request) => { window.saves.push(request); return later({ saved: "mask.png", version: "1" }); },
};
"""


@pytest.fixture
def room_page(browser):
    """The Masks room's page alone, before a server that answers a save when it is told to."""
    html, code = ((PAGE / f"mask_editor.{kind}").read_text(encoding="utf-8") for kind in ("html", "js"))
    page = browser.new_page()
    page.route("http://room.test/", lambda route: route.fulfill(body=f"<body>{html}</body>", content_type="text/html"))
    page.add_init_script("addEventListener('DOMContentLoaded', () => {" + FAKE + code + ";window.room = room;})")
    page.goto("http://room.test/")
    page.wait_for_function("window.room && room.view")
    yield page
    page.close()


def test_what_is_drawn_while_a_mask_is_saved_is_kept(room_page):
    page = room_page
    for key in ("p", "s", "s", "x"):  # a second save while the first is on its way would be a conflict with oneself
        page.locator("canvas").press(key)
    assert page.evaluate("saves.length") == 1
    page.evaluate("waiting.shift()()")
    page.wait_for_function("room.version === '1'")
    assert page.evaluate("room.edits.map((one) => one.tool)") == ["clear"]
    page.reload()
    page.wait_for_function("window.room && room.edits.length")
    assert page.evaluate("room.edits.map((one) => one.tool)") == ["clear"]
    assert "The mask was changed meanwhile" in page.locator(".said").text_content()


def test_a_save_that_ends_after_another_group_was_opened_leaves_that_alone(room_page):
    page = room_page
    for key in ("p", "s"):
        page.locator("canvas").press(key)
    page.locator(".group").select_option("b")
    page.wait_for_function("room.place === 'b/'")
    page.locator("canvas").press("x")
    page.evaluate("waiting.shift()()")
    page.wait_for_function("document.querySelector('.said').textContent.startsWith('Saved')")
    assert page.evaluate("[room.group, room.version, room.edits.length]") == ["b", "0", 1]
    assert page.evaluate("[sessionStorage.getItem('studio a/'), sessionStorage.getItem('studio b/') !== null]") == [
        None,
        True,
    ]


def test_the_last_of_two_choices_counts_whichever_answer_comes_first(room_page):
    page = room_page
    page.evaluate("window.slow = true")
    page.locator(".for").select_option("1.png")
    page.locator(".for").select_option("")
    page.evaluate("waiting.reverse().forEach((answer) => answer())")
    page.wait_for_function("document.querySelector('.said').textContent.includes('all photos')")
    page.wait_for_timeout(100)
    assert page.evaluate("[room.own, room.place]") == ["", "a/"]
