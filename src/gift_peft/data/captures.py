"""From a folder of raw photos to a checked, loadable GIFT-I: `gift-peft prepare RAW OUT` (paper, supplement A).

Each group is read (`raw.py`), registered to its last observation (`registration.py`), checked (`quality.py`) and
written whole or not at all (`writer.py`); about every frame the report says why it was kept, moved or dropped.

The report, `OUT/report.json`, is one object; paths are relative and use forward slashes:

```
format            1
raw               RAW, relative to OUT
settings          {"registration": {threshold: value}, "quality": {threshold: value}, and the other arguments}
versions          {"gift-peft", "opencv", "numpy", "pillow", "python"}
statistics        {"train" | "validation": {"groups", "images", "pairs", "references", "rejected_groups",
                  "dropped_frames", "warped_frames", "group_size": {"min", "max", "mean"} or null,
                  "mask_area": {"min", "max", "mean"} (fraction of the image) or null}}; a split without groups is absent
groups            list, in the order of the dataset, of:
  group_id        string
  split           "train" | "validation"
  surface         "mirror" | "transparent" | null
  notes           string | null (group.yaml)
  folder          the group's folder, relative to RAW
  status          "kept" | "rejected"
  reasons         list of {"code", "text"}: why it was rejected, [] if kept
  warnings        list of {"code", "text"} about the group as a whole
  size            [width, height] | null (unreadable)
  target_frame    name of the observation that the others are registered to | null
  quality         {"outside_change", "target_change", "mask_area", "mask_iou", ...}: measured figures, null if not measurable
  proposal        null | {"score", "accepted", "refined", "masks": [paths of masks_proposed/..., relative to OUT],
                  "mask_area", ...}
  frames          list, natural order, the treated reference last, of:
    name          the image's path inside the group's folder (what `image_names` holds)
    role          "observation" | "reference"
    status        "kept" (the frame that others are registered to, or a frame not yet judged when its group was rejected)
                  | "identity" (camera did not move: not resampled) | "warped" | "dropped"
    reasons       list of {"code", "text"}: why dropped, [] otherwise
    warnings      list of {"code", "text"}
    original      path relative to RAW
    prepared      path relative to OUT | null
    mask          prepared mask, relative to OUT | null (always null for the reference)
    valid         prepared valid mask, relative to OUT | null
    registration  null (target frame, or never reached) | {"method": "declared static" | "features" | "pixels",
                  "homography": 3 rows of 3 floats, frame -> target frame in pixels | null,
                  "matches", "inliers", "inlier_ratio", "spread", "median_displacement", "corner_displacement",
                  "target_displacement", "expected_error" (px at the target's corners), "contrast_threshold",
                  "difference_before", "difference_after" (mean absolute grey difference outside the target, 0-255),
                  "paper_exact": {"accepted": bool, "matches", "inliers", "inlier_ratio", "corner_displacement"}}; any
                  figure may be null
    quality       null | {"sharpness", "clipped_dark", "clipped_bright", "outside_change", "mask_area", ...}
```
"""
