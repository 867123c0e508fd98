"""Labels of pictures in files, moved along a flow: a COCO JSON, a folder of YOLO txt files, or a folder of masks.

Boxes and polygons of COCO and YOLO count from the edge of the first pixel, keypoints of COCO from its center.
"""

import hashlib
import io
import json
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple, cast

import cv2
import numpy as np
import torch
from PIL import Image
from torch import Tensor

from torchrefract._io import file_digest
from torchrefract._validation import UsageError, first_names
from torchrefract.data.coco import Annotation, decompressed, problem_of
from torchrefract.data.frames import list_names
from torchrefract.data.images import image_header, read_file
from torchrefract.labels.boxes import polygon_area, warp_boxes, warp_polygons
from torchrefract.labels.maps import warp_mask
from torchrefract.labels.points import in_frame, solve_points
from torchrefract.labels.vehicles import LabeledBoxes

_SUFFIXES = (".txt", ".png")  # of YOLO and masks
_SIMPLIFICATION_PX = 0.02  # largest distance between a warped outline and the polygon that is written
_DIGITS = 3  # of coordinates in a COCO JSON, px
_MIN_POSE = 7  # numbers of a box and a keypoint of YOLO
_UNIT_BOX = (0.0, 0.0, 1.0, 1.0)
_FARTHEST_SHARE = 1.0  # of the frame, outside of which numbers of a YOLO file are those of another format


class MovedLabels(NamedTuple):
    """Labels of one degraded picture: the content of its file, or its annotations in a COCO JSON."""

    content: Any  # bytes, or a list of annotations
    num_dropped: int  # labels that left the frame


class CocoAnnotations(NamedTuple):
    """The annotations of one picture in a COCO JSON."""

    annotations: list[Annotation]
    size: tuple[int, int]  # (H, W), as the JSON states it

    def move(self, flow: Tensor | None, size: tuple[int, int]) -> MovedLabels:
        """Move the annotations along a flow (2, H, W), px, None for none; raise ValueError for another size."""
        if self.size != size:
            height, width = self.size
            raise ValueError(
                f"labels must be of pictures as they are displayed, {size[0]}x{size[1]} (height x width), got "
                f"{height}x{width} in the JSON"
            )
        if flow is None or not self.annotations:
            return MovedLabels(self.annotations, 0)
        moved = [annotation for annotation in _moved_annotations(self.annotations, flow) if annotation]
        return MovedLabels(moved, len(self.annotations) - len(moved))


class YoloFile(NamedTuple):
    """The txt file of one picture: a line for each object, its class and x y w h or x y of the corners of a polygon."""

    path: Path

    def move(self, flow: Tensor | None, size: tuple[int, int]) -> MovedLabels:
        """Move boxes and polygons along a flow (2, H, W), px, None for none; raise ValueError for an invalid line."""
        data = read_file(self.path)
        rows = yolo_rows(data, self.path)
        if flow is None or not rows:
            return MovedLabels(data, 0)
        scale = torch.tensor([size[1], size[0]])
        values = {i: torch.tensor(numbers).view(-1, 2) * scale for i, (_, numbers) in enumerate(rows)}  # px
        boxes = {i: value for i, value in values.items() if len(value) == 2}  # center and size
        polygons = {i: value for i, value in values.items() if len(value) > 2}
        corners = [torch.cat([center - sides / 2, center + sides / 2]) for center, sides in boxes.values()]
        moved = dict[int, Tensor]()
        for i, box, is_kept in zip(boxes, *_moved_boxes(corners, flow), strict=True):
            if is_kept:
                moved[i] = torch.stack([(box[:2] + box[2:]) / 2, box[2:] - box[:2]])
        for i, polygon in zip(polygons, _moved_polygons(polygons.values(), flow), strict=True):
            if len(polygon):
                moved[i] = polygon
        lines = [
            " ".join([rows[i][0], *(f"{number:.6f}" for number in (moved[i] / scale).flatten().tolist())])
            for i in sorted(moved)
        ]
        return MovedLabels("".join(f"{line}\n" for line in lines).encode(), len(rows) - len(lines))

    def boxes(self, size: tuple[int, int]) -> tuple[np.ndarray, list[int]]:
        """Read the boxes (N, 4), x1, y1, x2, y2, px from the edge of the first pixel, and their classes.

        Args:
            size: (H, W) of the picture.

        Raises:
            ValueError: an invalid line.
        """
        rows = yolo_rows(read_file(self.path), self.path)
        points = [np.reshape(numbers, (-1, 2)) * (size[1], size[0]) for _, numbers in rows]
        # The center and size of a box, or the corners of a polygon.
        boxes = [
            [*(at[0] - at[1] / 2), *(at[0] + at[1] / 2)] if len(at) == 2 else [*at.min(axis=0), *at.max(axis=0)]
            for at in points
        ]
        return np.reshape(boxes, (-1, 4)), [int(name) for name, _ in rows]


class MaskFile(NamedTuple):
    """The mask of one picture: a PNG whose ids, or palette, or colors, keep every bit."""

    path: Path
    fill: int  # of pixels without a source

    def move(self, flow: Tensor | None, size: tuple[int, int]) -> MovedLabels:
        """Move the mask along a flow (2, H, W), px, None for none; raise ValueError for a mask of another size."""
        header = image_header(self.path)
        if header.size != size:
            raise ValueError(f"{self.path} must be of {size} px (height, width), as its picture, got {header.size}")
        data = read_file(self.path)
        if flow is None:
            return MovedLabels(data, 0)
        with Image.open(io.BytesIO(data)) as picture:
            # OpenCV would replace the indices of a palette, and single bits, by colors.
            has_indices = picture.mode in ("P", "1")
            ids = (
                np.asarray(picture)
                if has_indices
                else cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
            )
            if ids is None:
                raise ValueError(f"{self.path} is damaged: its pixels cannot be decoded")
            largest = {"bool": 1, "uint8": 255, "uint16": 65535}[str(ids.dtype)]
            if self.fill > largest:
                raise ValueError(f"mask_fill must be at most {largest}, the largest id of {self.path}, got {self.fill}")
            planes = torch.from_numpy(np.atleast_3d(ids).astype(np.int32)).permute(2, 0, 1)
            moved = (
                warp_mask(planes, flow, fill=self.fill).permute(1, 2, 0).numpy().astype(ids.dtype).reshape(ids.shape)
            )
            if not has_indices:
                return MovedLabels(cv2.imencode(".png", moved)[1].tobytes(), 0)
            stream, result = io.BytesIO(), Image.fromarray(moved)
            if picture.palette is not None:
                result.putpalette(picture.palette.getdata()[1], picture.palette.mode)
            result.save(stream, "png")
            return MovedLabels(stream.getvalue(), 0)


PictureLabels = CocoAnnotations | YoloFile | MaskFile


class LabelFolder(NamedTuple):
    """A folder of YOLO txt files or of masks, one for each picture, under its name."""

    root: Path
    suffix: str
    fill: int

    def of(self, name: str) -> YoloFile | MaskFile | None:
        """Return the labels of a picture; None if it has no txt file, and so no object."""
        path = self.root / PurePosixPath(name).with_suffix(self.suffix)
        if self.suffix == ".png":
            return MaskFile(path, self.fill)
        return YoloFile(path) if path.is_file() else None

    def digest(self) -> str:
        """Return a SHA-256 digest of the names and contents of the files."""
        return digest_of(self.root, self.suffix)

    def check(self, names: Sequence[str]) -> None:
        """Raise UsageError if a file is of none of the pictures, or if a picture has no mask."""
        expected = {PurePosixPath(name).with_suffix(self.suffix).as_posix() for name in names}
        files = files_with_suffix(self.root, self.suffix)
        check_named(files - expected, self.root)
        if self.suffix == ".png" and (missing := sorted(expected - files)):
            raise UsageError(
                f"labels must hold a mask for each picture, got none for {first_names(missing)} in {self.root}; add "
                "them, or move their pictures away"
            )


class CocoLabels(NamedTuple):
    """A COCO JSON, with its images by the name of their files."""

    path: Path
    document: dict[str, Any]
    images: dict[str, dict[str, Any]]
    annotations: Mapping[Any, list[Annotation]]  # by the id of their image

    def of(self, name: str) -> CocoAnnotations | None:
        """Return the annotations of a picture; None if the JSON does not list it."""
        if (image := self.images.get(name)) is None:
            return None
        return CocoAnnotations(self.annotations.get(image["id"], []), (int(image["height"]), int(image["width"])))

    def digest(self) -> str:
        """Return the SHA-256 digest of the file."""
        return file_digest(self.path)

    def check(self, names: Sequence[str]) -> None:
        """Raise UsageError if an image is none of the pictures."""
        check_named(self.images.keys() - {*names}, self.path)

    def with_moved(self, moved: Mapping[str, list[Annotation]]) -> bytes:
        """Return the JSON with the moved annotations of each picture, in their order, and without other images."""
        images = [image for name, image in self.images.items() if name in moved]
        # The ids of annotations may repeat, but no picture changes the order of its own.
        rest = {image["id"]: iter(moved[image["file_name"]]) for image in images}
        annotations = [annotation for image in rest.values() for annotation in image]
        document = {**self.document, "images": images, "annotations": annotations}
        return (json.dumps(document) + "\n").encode()


def read_labels(path: Path, *, fill: int) -> CocoLabels | LabelFolder:
    """Read a COCO JSON, or find the kind of the files in a folder.

    Raises:
        UsageError: the path is neither, the folder holds none or both kinds, or the JSON is not one of COCO.
    """
    if path.is_file() and path.suffix.lower() == ".json":
        return _read_coco(path)
    files = [*map(PurePosixPath, list_names(path))] if path.is_dir() else []
    kinds = {file.suffix for file in files} & {*_SUFFIXES}
    capital = [f.name for f in files if f.suffix != f.suffix.lower() and f.suffix.lower() in (kinds or _SUFFIXES)]
    if capital:
        raise UsageError(f"labels must end in .txt or .png, got {first_names(sorted(capital))} in {path}; rename them")
    if len(kinds) != 1:
        content = " and ".join(sorted(kinds)) or ("neither of both" if path.is_dir() else "no such file or folder")
        raise UsageError(
            f"labels must be a COCO JSON, or a folder of YOLO files (.txt) or masks (.png), got {path} with {content}"
        )
    return LabelFolder(path, kinds.pop(), fill)


def _read_coco(path: Path) -> CocoLabels:
    try:
        document = json.loads(path.read_bytes())
        images = {image["file_name"]: image for image in document["images"]}
        ids = {image["id"]: (int(image["height"]), int(image["width"])) for image in document["images"]}
        annotations = defaultdict[Any, list[Annotation]](list)
        for annotation in document["annotations"]:
            annotations[annotation["image_id"]].append(annotation)
        if not {*map(type, images)} <= {str} or not isinstance(document.get("categories", []), list):
            raise TypeError("file_name must be a text and categories a list")
    except (ValueError, TypeError, LookupError, RecursionError) as error:
        raise UsageError(
            f"labels must be a COCO JSON with images (id, file_name, width, height) and annotations (image_id), got "
            f"{path} ({type(error).__name__}: {error})"
        ) from error
    if not len(images) == len(ids) == len(document["images"]):
        raise UsageError(f"labels must list each image once, got an id or a file_name twice in {path}")
    if others := annotations.keys() - ids:
        raise UsageError(
            f"labels must have an image for each annotation, got image_id {first_names(sorted(map(str, others)))}, "
            f"which {path} does not list; remove them, or add the images"
        )
    for annotation in document["annotations"]:
        if problem := problem_of(annotation):
            raise UsageError(
                f"labels must be a valid COCO JSON, got {path}, whose annotation {annotation.get('id')} {problem}"
            )
    boxes = [annotation["bbox"] for annotation in document["annotations"] if annotation.get("bbox")]
    if boxes and max(map(max, boxes)) <= 1:
        raise UsageError(
            f"labels must have boxes in px, got {path} with shares of the frame; multiply them by its sides"
        )
    return CocoLabels(path, document, images, annotations)


def files_with_suffix(root: Path, suffix: str) -> set[str]:
    """Return the names of the files of a folder and its sub-folders that have a suffix, relative to the folder."""
    return {name for name in list_names(root) if name.endswith(suffix)}


def digest_of(root: Path, suffix: str) -> str:
    """Return a SHA-256 digest of the names and contents of the files of `files_with_suffix`."""
    digest = hashlib.sha256()
    for name in sorted(files_with_suffix(root, suffix), key=PurePosixPath):
        digest.update(ascii((name, file_digest(root / name))).encode())
    return digest.hexdigest()


def check_named(others: Collection[str], path: Path) -> None:
    """Raise UsageError if there are labels of other names than the pictures."""
    if others:
        raise UsageError(
            f"labels must name pictures of source, got {first_names(sorted(others))} in {path}, which source does not "
            "hold; give the folder that these names are relative to, or remove them"
        )


def _moved_annotations(annotations: Sequence[Annotation], flow: Tensor) -> Iterator[Annotation | None]:
    """Yield each annotation with its geometry moved along a flow (2, H, W), px; None if it left the frame."""
    boxes = torch.tensor([annotation.get("bbox") or _UNIT_BOX for annotation in annotations])
    boxes, keep = _moved_boxes([*torch.cat([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]], dim=1)], flow)
    parts = [torch.tensor(part).view(-1, 2) for annotation in annotations for part in _polygons(annotation)]
    outlines = iter(_moved_polygons(parts, flow))
    # One search for all points of a picture takes hardly longer than one for a single point.
    keypoints = iter(_moved_keypoints([v for row in annotations for v in row.get("keypoints") or ()], flow))
    for annotation, box, is_kept in zip(annotations, boxes, keep.tolist(), strict=True):
        moved, is_visible, area = dict(annotation), True, None
        if annotation.get("bbox"):
            x1, y1, x2, y2 = box.tolist()
            moved["bbox"] = _rounded([x1, y1, x2 - x1, y2 - y1])
            is_visible, area = is_kept, (x2 - x1) * (y2 - y1)
        if annotation.get("segmentation"):
            visible = [part for _ in _polygons(annotation) if len(part := next(outlines))]
            if isinstance(annotation["segmentation"], dict):
                moved["segmentation"], area = _moved_run_lengths(annotation["segmentation"], flow)
            else:
                moved["segmentation"] = [_rounded(part.flatten().tolist()) for part in visible]
                area = sum(map(polygon_area, visible))
            is_visible = is_visible and area > 0
        if annotation.get("keypoints"):
            moved["keypoints"] = [*islice(keypoints, len(annotation["keypoints"]))]
            moved["num_keypoints"] = sum(value > 0 for value in moved["keypoints"][2::3])
        if "area" in annotation and area is not None:
            moved["area"] = round(area, _DIGITS)
        yield moved if is_visible else None


def _polygons(annotation: Annotation) -> list[list[float]]:
    parts = annotation.get("segmentation")
    return parts if isinstance(parts, list) else []


def _moved_boxes(corners: Sequence[Tensor], flow: Tensor) -> tuple[Tensor, Tensor]:
    """Move boxes x1, y1, x2, y2 that count from the edge, px; return them (N, 4), and which to keep (N,)."""
    boxes, keep = warp_boxes(torch.stack([*corners]) - 0.5 if corners else torch.empty(0, 4), flow)
    return boxes + 0.5, keep


def _moved_polygons(polygons: Collection[Tensor], flow: Tensor) -> list[Tensor]:
    """Move polygons (N, 2) that count from the edge, px; leave out points that the new edges pass within 0.02 px."""
    moved = []
    for polygon in warp_polygons([polygon - 0.5 for polygon in polygons], flow):
        points = (
            cv2.approxPolyDP(polygon.float().numpy(), _SIMPLIFICATION_PX, closed=True)[:, 0] if len(polygon) else ()
        )
        moved.append(torch.from_numpy(points) + 0.5 if len(points) > 2 else torch.empty(0, 2))
    return moved


def _moved_keypoints(keypoints: Sequence[float], flow: Tensor) -> list[float]:
    """Move x, y, v of each keypoint; those that leave the frame become 0, 0, 0, which COCO calls not labeled."""
    if not keypoints:
        return []
    rows = torch.tensor(keypoints, dtype=flow.dtype).view(1, -1, 3)
    points, converged, upright = solve_points(rows[..., :2], flow[None])
    is_visible = converged & upright & in_frame(points, flow[None], 0.5) & (rows[..., 2] > 0)
    flat = (torch.cat([points, rows[..., 2:]], dim=2) * is_visible[..., None])[0].tolist()
    return [value for x, y, v in flat for value in (*_rounded([x, y]), int(v))]


def _moved_run_lengths(code: Mapping[str, Any], flow: Tensor) -> tuple[dict[str, Any], int]:
    """Move a run-length code of COCO, whose runs go down the columns; return it uncompressed, and its area in px^2."""
    height, width = code["size"]
    if (height, width) != tuple(flow.shape[1:]):
        raise ValueError(f"labels must have run-length codes of the size of the picture, got {height}x{width}")
    if isinstance(code["counts"], list):
        flat = np.repeat(np.arange(len(code["counts"])) % 2, code["counts"]).astype(np.uint8)
        mask = flat.reshape(width, height).T
    else:
        mask = cast(np.ndarray, decompressed(code))  # checked when the JSON was read
    moved = warp_mask(torch.from_numpy(np.ascontiguousarray(mask))[None], flow)[0].numpy()
    columns = np.concatenate([[0], moved.T.ravel()])  # codes begin with a run of zeros, which may be empty
    ends = np.flatnonzero(np.diff(columns)).tolist()
    counts = np.diff([0, *ends, height * width]).tolist()
    return {"size": [height, width], "counts": counts}, int(moved.sum())


def _rounded(values: Iterable[float]) -> list[float]:
    return [round(value, _DIGITS) for value in values]


def yolo_rows(data: bytes, path: Path) -> list[tuple[str, list[float]]]:
    """Return the class and the numbers of each line of a YOLO file: x y w h, or x y of the corners of a polygon.

    Raises:
        ValueError: a line is neither; names the path.
    """
    return [_yolo_row(line, f"{path}, line {i}") for i, line in enumerate(data.splitlines(), 1) if line.split()]


def _yolo_row(line: bytes, place: str) -> tuple[str, list[float]]:
    """Return the class and the numbers of a line of a YOLO file."""
    label, *words = line.decode("utf-8-sig", errors="replace").split()
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if _are_keypoints(numbers):
        raise ValueError(
            f"{place}, must be a box or a polygon, got keypoints x y visibility after a box; give them as a COCO JSON"
        )
    is_form = label.isdecimal() and len(numbers) in (4, *range(6, len(numbers) + 1, 2))
    if not is_form or not all(-_FARTHEST_SHARE <= number <= 1 + _FARTHEST_SHARE for number in numbers):
        got = " ".join([label, *words])[:80]
        raise ValueError(
            f"{place}, must be a class with x y w h, or with x y of three or more corners, as shares of the frame, "
            f"got {got}"
        )
    return label, numbers


def _are_keypoints(numbers: list[float]) -> bool:
    """Return True for x y w h of a box and x y visibility of keypoints, the visible ones of which lie near the box."""
    if len(numbers) < _MIN_POSE or len(numbers) % 3 != 1 or not {*numbers[6::3]} <= {0, 1, 2}:
        return False
    x, y, width, height = numbers[:4]
    keypoints = zip(numbers[4::3], numbers[5::3], numbers[6::3], strict=True)
    return all(v == 0 or (abs(a - x) <= width and abs(b - y) <= height) for a, b, v in keypoints)


def boxes_of_coco(annotations: Sequence[Annotation]) -> np.ndarray:
    """Return the boxes (N, 4), x1, y1, x2, y2, px from the edge of the first pixel, of annotations with a bbox."""
    corners = np.reshape([annotation["bbox"] for annotation in annotations], (-1, 4)).astype(float)
    return np.concatenate([corners[:, :2], corners[:, :2] + corners[:, 2:]], axis=1)


def category_names(labels: CocoLabels) -> dict[int, str]:
    """Return the names of the categories of a COCO JSON, by id."""
    categories = [entry for entry in labels.document.get("categories", ()) if isinstance(entry, dict)]
    return {entry["id"]: str(entry["name"]) for entry in categories if "id" in entry and "name" in entry}


def labeled_boxes(labels: PictureLabels | None, size: tuple[int, int], names: Mapping[int, str]) -> LabeledBoxes:
    """Return the boxes of a picture of `size` (H, W) with their classes: names of COCO, numbers of YOLO."""
    boxes, classes = np.zeros((0, 4)), []
    if isinstance(labels, YoloFile):
        boxes, classes = labels.boxes(size)
    elif isinstance(labels, CocoAnnotations):
        annotations = [annotation for annotation in labels.annotations if annotation.get("bbox")]
        boxes = boxes_of_coco(annotations)
        ids = [annotation.get("category_id", -1) for annotation in annotations]
        classes = [names.get(number, number) for number in ids]
    return LabeledBoxes(torch.from_numpy(boxes).float() - 0.5, classes)
