"""Photos that are registered twice, with other masks, are searched for features once; that changes no figure."""

import gc
import json
import shutil
import weakref

import cv2
import numpy as np
import pytest
from helpers.photos import SETTINGS, capture, frames, motion

from gift_peft.prepare import matching
from gift_peft.prepare.matching import Frame
from gift_peft.prepare.photo import Photo
from gift_peft.prepare.prepare import prepare_gift_i
from gift_peft.prepare.settings import PrepareSettings

SIZE = (160, 200)


@pytest.fixture
def searches(monkeypatch):
    """The pictures that features were looked for in, by their pixels."""
    seen, create = [], cv2.SIFT_create

    class Sift:
        def __init__(self, **options):
            self.sift = create(**options)

        def detectAndCompute(self, gray, mask):
            seen.append(gray.tobytes())
            return self.sift.detectAndCompute(gray, mask)

    monkeypatch.setattr(matching.cv2, "SIFT_create", Sift)
    return seen


@pytest.mark.parametrize("how", ["carried", "proposed"])
def test_each_photo_is_searched_once(tmp_path, searches, monkeypatch, how):
    raw = tmp_path / "raw"
    motions = [motion(np.random.default_rng(3), SIZE, translation=4, degrees=0)]
    group = capture(raw / "train/g", 14, count=3, size=SIZE, motions=motions, reference=True)
    settings = PrepareSettings()
    if how == "carried":
        for mask in sorted((group / "masks").iterdir())[:-1]:
            mask.unlink()
    else:
        shutil.rmtree(group / "masks")
        settings = PrepareSettings(propose_masks=True, accept_proposed_masks=True, min_proposal_score=0)
    prepare_gift_i(raw, tmp_path / "out", settings)
    assert len(searches) == len(set(searches)) == 4
    # As if nothing were known of the first time.
    init = Frame.__init__
    monkeypatch.setattr(Frame, "__init__", lambda self, *picture: init(self, *picture[:3]))
    prepare_gift_i(raw, tmp_path / "anew", settings)
    assert len(searches) > 2 * 4
    reports = [json.loads((tmp_path / name / "report.json").read_text())["groups"] for name in ("out", "anew")]
    assert reports[0] == reports[1] and reports[0][0]["status"] == "kept"


def test_descriptors_are_sifts_own():
    picture, mask, frame = frames(3)
    low = min(SETTINGS.min_contrast_threshold, SETTINGS.contrast_threshold)
    sift = cv2.SIFT_create(contrastThreshold=low, edgeThreshold=SETTINGS.edge_threshold)
    keypoints, descriptors = sift.detectAndCompute(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), None)
    points, found = frame.features(0.0, outside_only=False)
    assert len(keypoints) > 50 and found.dtype == np.float32
    assert np.array_equal(points, [keypoint.pt for keypoint in keypoints]) and np.array_equal(found, descriptors)
    other = Frame(picture, ~mask, SETTINGS, frame.picture)
    anew = Frame(picture, ~mask, SETTINGS)
    for one, two in zip(other.features(low), anew.features(low), strict=True):
        assert np.array_equal(one, two) and len(one) < len(points)


def test_of_a_photo_that_waits_for_its_second_time_no_frame_is_kept():
    """Its masks and brightness in float32 are 8 bytes for each pixel of each photo of a group."""
    picture, mask, _ = frames(3)
    photo = Photo(None, picture, picture, mask)
    frame = photo.frame(mask, SETTINGS, again=True)
    found, kept = frame.features(0.0, outside_only=False), weakref.ref(frame)
    del frame
    gc.collect()
    assert kept() is None
    again = photo.frame(~mask, SETTINGS, again=False)
    assert again.picture.features[0] is not None and np.array_equal(again.features(0.0, False)[0], found[0])
