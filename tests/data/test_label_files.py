"""Labels in files keep their form and follow the flow of their picture."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from pycocotools import mask as coco_mask
from torch import Tensor

from torchrefract import LensDistortion, warp_boxes, warp_mask, warp_points
from torchrefract._validation import UsageError
from torchrefract.data.label_files import (
    CocoAnnotations,
    CocoLabels,
    LabelFolder,
    MaskFile,
    YoloFile,
    read_labels,
    yolo_rows,
)

SIZE = HEIGHT, WIDTH = (60, 80)
BOX = {"id": 1, "bbox": [10.0, 20.0, 30.0, 16.0], "category_id": 2, "area": 480.0, "iscrowd": 0, "note": "kept"}
SQUARE = [10.0, 20.0, 40.0, 20.0, 40.0, 36.0, 10.0, 36.0]


def shift(x: float, y: float) -> Tensor:
    """Return a flow that moves the content by (x, y)."""
    return -torch.tensor([x, y]).view(2, 1, 1).expand(2, *SIZE)


def lens() -> Tensor:
    effect = LensDistortion(k1_range=(-0.4, -0.4), k2_range=(0.15, 0.15), tolerance_px=None)
    return effect.degrade(torch.rand(1, 3, *SIZE), seed=0).flow[0]


def moved(flow: Tensor | None, *annotations: dict[str, Any]) -> tuple[list[dict[str, Any]], int]:
    return CocoAnnotations([*annotations], SIZE).move(flow, SIZE)


@pytest.mark.quick
def test_a_box_of_which_less_than_a_pixel_remains_is_dropped():
    assert moved(shift(69.8, 0.0), BOX) == ([], 1)  # 0.2 px
    assert moved(shift(68.8, 0.0), BOX)[1] == 0


@pytest.mark.quick
def test_boxes_and_polygons_count_from_the_edge_and_keypoints_from_the_center_of_a_pixel():
    keypoints = {"keypoints": [10, 20, 2, 79, 30, 1, 0, 0, 0], "num_keypoints": 2}
    (box,), dropped = moved(shift(5.0, -3.0), BOX | {"segmentation": [SQUARE]} | keypoints)
    assert dropped == 0
    assert box["bbox"] == [15.0, 17.0, 30.0, 16.0]
    corners = {(15.0, 17.0), (45.0, 17.0), (45.0, 33.0), (15.0, 33.0)}
    assert {*zip(box["segmentation"][0][::2], box["segmentation"][0][1::2], strict=True)} == corners
    assert (box["keypoints"], box["num_keypoints"]) == ([15.0, 17.0, 2, 0.0, 0.0, 0, 0.0, 0.0, 0], 1)
    assert (box["area"], box["category_id"], box["note"]) == (480.0, 2, "kept")
    # The frame ends at 80 px: 7 of 30 px remain, then nothing.
    (cut,), dropped = moved(shift(63.0, 0.0), BOX | {"segmentation": [SQUARE]})
    assert (cut["bbox"], cut["area"], dropped) == ([73.0, 20.0, 7.0, 16.0], 112.0, 0)
    # An object goes with its outline, even if a corner of its box stays.
    assert moved(shift(63.0, 0.0), BOX | {"segmentation": [[30.0, 20.0, 40.0, 20.0, 40.0, 36.0]]}) == ([], 1)
    assert moved(shift(71.0, 0.0), BOX, BOX | {"bbox": [0.0, 0.0, 5.0, 5.0]})[1] == 1


@pytest.mark.quick
def test_annotations_follow_a_lens_like_the_functions_of_labels():
    flow, ids = lens(), np.zeros(SIZE, np.uint8)
    ids[20:36, 10:40] = 1
    crowd = {"id": 2, "iscrowd": 1, "bbox": BOX["bbox"], "area": 480.0}
    code: Any = coco_mask.encode(np.asfortranarray(ids))
    compressed = crowd | {"segmentation": {"size": [*SIZE], "counts": code["counts"].decode()}}
    ends = np.flatnonzero(np.diff(ids.T.ravel(), prepend=0))  # of the runs, down the columns
    counts = np.diff(np.array([0, *ends, ids.size])).tolist()
    uncompressed = crowd | {"segmentation": {"size": [*SIZE], "counts": counts}}
    person = BOX | {"segmentation": [SQUARE], "keypoints": [20, 25, 2]}
    (first, second, third), _ = moved(flow, person, compressed, uncompressed)
    box, _ = warp_boxes(torch.tensor([[9.5, 19.5, 39.5, 35.5]]), flow)
    expected = (box[0] + 0.5).tolist()
    for annotation in (first, second, third):
        x, y, w, h = annotation["bbox"]
        assert [x, y, x + w, y + h] == pytest.approx(expected, abs=2e-3)
    point, visible = warp_points(torch.tensor([[20.0, 25.0]]), flow)
    assert visible.all()
    assert first["keypoints"] == pytest.approx([*point[0].tolist(), 2], abs=1e-3)
    warped = warp_mask(torch.from_numpy(ids)[None], flow)[0].numpy()
    for annotation in (second, third):
        read = coco_mask.decode(coco_mask.frPyObjects(annotation["segmentation"], *SIZE))
        assert np.array_equal(read, warped)
        assert (annotation["area"], annotation["iscrowd"]) == (warped.sum(), 1)
    polygon = coco_mask.decode(coco_mask.merge(coco_mask.frPyObjects(first["segmentation"], *SIZE)))
    edge = cv2.dilate(warped, np.ones((3, 3))) != cv2.erode(warped, np.ones((3, 3)))
    assert not ((polygon != warped) & ~edge).any()
    assert first["area"] == pytest.approx(warped.sum(), rel=0.03)


@pytest.mark.quick
def test_yolo_files_keep_their_order_and_drop_what_leaves_the_frame(tmp_path):
    path = tmp_path / "a.txt"
    polygon = " ".join(f"{v / s:.6f}" for v, s in zip(SQUARE, [WIDTH, HEIGHT] * 4, strict=True))
    path.write_text(f"3 0.9375 0.5 0.1 0.1\n5 {polygon}\n7 0.25 0.5 0.25 0.2\n\n")
    content, dropped = YoloFile(path).move(shift(16.0, 6.0), SIZE)
    lines = [line.split() for line in content.decode().splitlines()]
    assert dropped == 1
    assert [line[0] for line in lines] == ["5", "7"]
    numbers = [float(number) for number in lines[0][1:]]
    corners = sorted(zip(numbers[::2], numbers[1::2], strict=True))
    assert np.array(corners) == pytest.approx(
        np.array([(x / WIDTH, y / HEIGHT) for x in (26, 56) for y in (26, 42)]), abs=1e-5
    )
    assert [float(number) for number in lines[1][1:]] == pytest.approx([0.45, 0.6, 0.25, 0.2], abs=1e-5)
    assert YoloFile(path).move(None, SIZE) == (path.read_bytes(), 0)


@pytest.mark.quick
@pytest.mark.parametrize("others", [("a.txt",), ()])
def test_labels_whose_suffix_has_capital_letters_are_named(tmp_path, others):
    for name in ("B.TXT", *others):
        (tmp_path / name).write_text("0 0.5 0.5 0.2 0.2\n")
    with pytest.raises(UsageError, match=r"labels must end in .txt or .png, got B.TXT in .*; rename them$"):
        read_labels(tmp_path, fill=255)


@pytest.mark.parametrize(
    "line",
    [
        *("0 0.5 0.5 0.1", "0 0.5 0.5 0.1 nan", "0 0.5 0.5 0.1 0.1 0.9", "0 a b c d", "0", "car 0.5 0.5 0.1 0.1"),
        *("0 40 30 8 6", "Car 0.0 0 -1.6 587.0 173.3 614.1 200.1 1.65 1.67 3.64 -0.65 1.71 46.7 -1.59"),  # px; KITTI
    ],
)
def test_an_invalid_line_of_a_yolo_file_is_named(tmp_path, line):
    (tmp_path / "a.txt").write_text(f"0 0.5 0.5 0.1 0.1\n{line}\n")
    with pytest.raises(ValueError, match=r"a\.txt, line 2, must be a class with x y w h, or with x y of three or more"):
        YoloFile(tmp_path / "a.txt").move(shift(1.0, 0.0), SIZE)


@pytest.mark.quick
@pytest.mark.parametrize(
    "keypoints",
    [
        *("0.45 0.4 2 0.55 0.6 2", "0.45 0.4 1 0.55 0.6 0", "0.45 0.4 1 0 0 0 0.5 0.5 2", "0.45 0.4 1"),
        "0.45 0.4 0 0.55 0.4 1 0.55 0.6 1 0.45 0.6 1",
    ],
)
def test_keypoints_of_yolo_are_no_corners_of_a_polygon(tmp_path, keypoints):
    (tmp_path / "a.txt").write_text(f"0 0.5 0.5 0.2 0.3 {keypoints}\n")
    with pytest.raises(ValueError, match=r"line 1, must be .*, got keypoints x y visibility .*as a COCO JSON"):
        YoloFile(tmp_path / "a.txt").move(shift(1.0, 0.0), SIZE)


@pytest.mark.quick
def test_a_polygon_along_the_border_and_a_byte_order_mark_are_read(tmp_path):
    numbers = [0, 0, 0.5, 0.2, 1, 0, 1, 0.6, 0, 1]  # of five corners, 1 and 1 where keypoints have visibilities
    (tmp_path / "a.txt").write_text(f"0 {' '.join(map(str, numbers))}\r\n", encoding="utf-8-sig")
    assert yolo_rows((tmp_path / "a.txt").read_bytes(), tmp_path / "a.txt") == [("0", numbers)]


@pytest.mark.quick
@pytest.mark.parametrize("kind", ["uint8", "uint16", "color", "palette", "bit"])
def test_masks_keep_every_bit_and_their_form(tmp_path, kind):
    path, generator = tmp_path / "a.png", np.random.default_rng(0)
    largest = {"uint16": 65535, "bit": 1}.get(kind, 255)
    ids = generator.integers(0, largest, (*SIZE, 3) if kind == "color" else SIZE, endpoint=True)
    ids = ids.astype({"uint16": np.uint16, "bit": bool}.get(kind, np.uint8))
    if kind in ("palette", "bit"):
        picture = Image.fromarray(ids)
        if kind == "palette":
            picture.putpalette(generator.integers(0, 255, 768).tolist())
        picture.save(path)
    else:
        assert cv2.imwrite(str(path), ids)
    flow = lens()
    planes = torch.from_numpy(np.atleast_3d(ids).astype(np.int64)).permute(2, 0, 1)
    expected = warp_mask(planes, flow, fill=1).permute(1, 2, 0).numpy().reshape(ids.shape)
    (tmp_path / "b.png").write_bytes(MaskFile(path, 1).move(flow, SIZE)[0])
    with Image.open(path) as before, Image.open(tmp_path / "b.png") as after:
        assert before.mode == after.mode
        assert before.getpalette() == after.getpalette()
        read = np.asarray(after)
    if kind in ("color", "uint16"):
        read = np.asarray(cv2.imread(str(tmp_path / "b.png"), cv2.IMREAD_UNCHANGED))
    assert np.array_equal(read.astype(np.int64), expected)
    assert MaskFile(path, 1).move(None, SIZE) == (path.read_bytes(), 0)


@pytest.mark.quick
def test_masks_of_another_size_and_ids_that_do_not_fit_raise(tmp_path):
    assert cv2.imwrite(str(tmp_path / "a.png"), np.zeros(SIZE, np.uint8))
    with pytest.raises(ValueError, match=r"a\.png must be of \(61, 80\) px \(height, width\), as its picture"):
        MaskFile(tmp_path / "a.png", 0).move(None, (61, 80))
    with pytest.raises(ValueError, match="mask_fill must be at most 255, the largest id of"):
        MaskFile(tmp_path / "a.png", 256).move(shift(1.0, 0.0), SIZE)
    with pytest.raises(ValueError, match=r"labels must be of pictures as they are displayed, 80x60"):
        CocoAnnotations([], SIZE).move(None, (80, 60))


def write_coco(path: Path, **changes: Any) -> Path:
    images = [{"id": k, "file_name": f"{k}.png", "height": HEIGHT, "width": WIDTH} for k in range(2)]
    path.write_text(json.dumps({"images": images, "annotations": [BOX | {"image_id": 0}]} | changes))
    return path


def run_lengths(*counts: Any) -> dict[str, Any]:
    return {"size": [*SIZE], "counts": counts[0] if isinstance(counts[0], str) else [*counts]}


@pytest.mark.quick
def test_a_json_of_coco_may_have_sizes_as_text_and_other_entries(tmp_path):
    others = {"attributes": {"rotation": 0.0, "occluded": True}, "bbox_3d": [1, 2, 3, 4, 5, 6, 7], "num_lanes": 2}
    images = [{"id": 0, "file_name": "0.png", "height": str(HEIGHT), "width": str(WIDTH)}]
    path = write_coco(tmp_path / "a.json", images=images, annotations=[BOX | others | {"image_id": 0}])
    labels = read_labels(path, fill=0).of("0.png")
    assert isinstance(labels, CocoAnnotations)
    (annotation,) = labels.move(shift(2.0, 0.0), SIZE).content
    assert others.items() <= annotation.items()


@pytest.mark.quick
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"images": None}, "labels must be a COCO JSON with images"),
        ({"annotations": [{"id": 1}]}, "KeyError: 'image_id'"),
        ({"categories": None}, "TypeError: file_name must be a text and categories a list"),
        ({"images": [{"id": 0, "file_name": None, "height": 1, "width": 1}]}, "TypeError: file_name must be a text"),
        ({"annotations": [BOX | {"image_id": 9}]}, "an image for each annotation, got image_id 9, which"),
        ({"annotations": [BOX | {"image_id": 0, "bbox": [1, 2, 3]}]}, "annotation 1 has a bbox that is not"),
        ({"annotations": [BOX | {"image_id": 0, "segmentation": [[1, 2, 3, 4]]}]}, "has a segmentation that is not"),
        ({"annotations": [BOX | {"image_id": 0, "segmentation": {"size": 3}}]}, "a run-length code without counts"),
        ({"annotations": [BOX | {"image_id": 0, "keypoints": [1, 2]}]}, "has keypoints that are not x, y, visibility"),
        ({"annotations": [BOX | {"image_id": 0, "keypoints": [20, 15, 0.9]}]}, "whose visibility is not 0, 1 or 2"),
        ({"annotations": [BOX | {"image_id": 0, "keypoints": [20, 15, 30, 20, 25, 16]}]}, "visibility is not 0, 1 or"),
        ({"annotations": [BOX | {"image_id": 0, "segmentation": run_lengths(100, 50)}]}, "whose counts do not add up"),
        ({"annotations": [BOX | {"image_id": 0, "segmentation": run_lengths(-1, 4801)}]}, "whose counts do not add up"),
        (
            {"annotations": [BOX | {"image_id": 0, "segmentation": run_lengths("not run lengths")}]},
            "counts that cannot be decoded",
        ),
        ({"annotations": [BOX | {"image_id": 0, "polygon": [1, 2, 3, 4, 5, 6]}]}, "has polygon, positions that would"),
        ({"annotations": [BOX | {"image_id": 0, "vbox": [1, 2, 3, 4]}]}, "has vbox, positions that would stay"),
        ({"annotations": [BOX | {"image_id": 0, "bbox2D_proj": [1, 2, 3, 4]}]}, "has bbox2D_proj, positions that"),
        (
            {"annotations": [BOX | {"image_id": 0, "bbox_mode": 0}]},
            "has a bbox of bbox_mode 0, which is not x, y, width",
        ),
        ({"annotations": [BOX | {"image_id": 0, "bbox": [0.1, 0.2, 0.3, 0.4]}]}, "boxes in px, got .* shares of the"),
        ({"annotations": [BOX | {"image_id": 0, "attributes": {"rotation": 30.0}}]}, "a box that is turned by 30"),
        ({"annotations": [{"image_id": 0, "segments_info": []}]}, "panoptic labels, which cannot be moved"),
        ({"images": 2 * [{"id": 0, "file_name": "0.png", "height": 1, "width": 1}]}, "must list each image once"),
    ],
)
def test_an_invalid_json_of_coco_is_named(tmp_path, changes, message):
    with pytest.raises(UsageError, match=message):
        read_labels(write_coco(tmp_path / "a.json", **changes), fill=0)


@pytest.mark.quick
def test_folders_and_json_are_told_apart_and_compared_with_the_pictures(tmp_path):
    labels = read_labels(write_coco(tmp_path / "a.json"), fill=0)
    assert isinstance(labels, CocoLabels)
    labels.check(["0.png", "1.png", "2.png"])
    assert labels.of("2.png") is None
    assert labels.of("1.png") == ([], SIZE)
    (tmp_path / "txt").mkdir()
    (tmp_path / "txt" / "0.txt").write_text("")
    labels = read_labels(tmp_path / "txt", fill=0)
    assert isinstance(labels, LabelFolder)
    labels.check(["0.png", "1.png"])
    assert (labels.of("0.png"), labels.of("1.png")) == (YoloFile(tmp_path / "txt" / "0.txt"), None)
    (tmp_path / "txt" / "0.png").write_text("")
    with pytest.raises(UsageError, match=r"labels must be .* with \.png and \.txt"):
        read_labels(tmp_path / "txt", fill=0)
    (tmp_path / "txt" / "0.txt").unlink()
    with pytest.raises(UsageError, match=r"labels must hold a mask for each picture, got none for 1\.png"):
        read_labels(tmp_path / "txt", fill=0).check(["0.jpg", "1.jpg"])


@pytest.mark.quick
@pytest.mark.parametrize("suffix", [".txt", ".png"])
def test_the_digest_of_a_folder_changes_with_the_content_of_a_file_of_the_same_size(tmp_path, suffix):
    digests = []
    for content in (b"0 .5 .5 .2 .2", b"1 .5 .5 .2 .2"):
        (tmp_path / f"a{suffix}").write_bytes(content)
        digests += [read_labels(tmp_path, fill=0).digest() for _ in range(2)]
    assert digests[0] == digests[1] != digests[2] == digests[3]
