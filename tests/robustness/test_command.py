import base64
import csv
import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from pictures import files_in, save_picture
from PIL import Image
from torchvision import models

from torchrefract import presets
from torchrefract.data.depth_maps import DepthFolder, write_depth
from torchrefract.robustness.predictors import load_predictor
from torchrefract.robustness.quantities import SCENES, quantity_of

DETECT = "model=bright:detect"
DASHCAM = ("scene=cheap_dashcam", "severity=1")
MODEL = """
import torch

def detect(images):
    '''Detect the bright square.'''
    if images.amin() > 0.99:
        raise RuntimeError("a white picture")
    rows, columns = (images[0].mean(dim=0) > 0.6).nonzero().unbind(1)
    if len(rows) == 0:
        return [{"boxes": torch.zeros(0, 4), "labels": torch.zeros(0).long(), "scores": torch.zeros(0)}]
    box = torch.stack([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]).float()
    return [{"boxes": box[None], "labels": torch.tensor([1]), "scores": torch.tensor([0.9])}]

def count(prediction, target):
    return float(len(prediction["boxes"]) == len(target["boxes"]))

def brightness(images):
    return images.mean(dim=(1, 2, 3))[:, None]

def darkness(prediction, target):
    return 1 - prediction.item()

def nobody(prediction, target):
    return None

def one(images):
    return detect(images)[0]

def segment(images):
    return torch.stack([1 - images[:, 0], images[:, 0] - 0.9], dim=1)

def none(images):
    return None

network = torch.nn.Sequential(torch.nn.AdaptiveAvgPool2d(1), torch.nn.Flatten(), torch.nn.Linear(3, 2))
"""


@pytest.fixture
def frames(tmp_path, write_module) -> Path:
    """Write four pictures with a bright square, their labels, and a model."""
    folder = tmp_path / "frames"
    images, rows = [], []
    for i in range(4):
        picture = np.full((72, 128, 3), 90, np.uint8)
        picture[30:50, 40 + 10 * i : 60 + 10 * i] = 255
        save_picture(folder / f"{i} a=b.png", picture)
        images.append({"id": i, "file_name": f"{i} a=b.png", "height": 72, "width": 128})
        rows.append({"id": i, "image_id": i, "bbox": [40 + 10 * i, 30, 20, 20], "category_id": 1})
    (tmp_path / "coco.json").write_text(json.dumps({"images": images, "annotations": rows}))
    write_module("bright", MODEL)
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in files_in(folder)}


def kill(out: Path) -> None:
    """Leave the files of a run that is killed while it writes its third score."""
    lines = (out / "scores.jsonl").read_bytes().splitlines(keepends=True)
    for path in out.iterdir():
        path.unlink()
    (out / "scores.jsonl").write_bytes(b"".join(lines[:3]) + lines[3][:20])


def test_a_run_writes_tables_and_a_report_and_continues_with_equal_bytes(score, tmp_path, frames):
    words = (DETECT, "labels=coco.json", "scene=[cape_town_fog,cheap_dashcam]", "severity=[1,5]")
    outcome = score(*words)
    assert outcome.code == 0
    assert "out/report.html: 4 pictures, clean score 1.000" in outcome.out
    complete = contents(tmp_path / "out")
    assert set(complete) == {"results.csv", "results.json", "report.html", "scores.jsonl"}
    results = json.loads(complete["results.json"])
    assert results["clean"]["value"] == results["set_scores"]["mAP50"]["clean"] == pytest.approx(1)
    assert [row["scene"] for row in results["levels"]] == ["cape_town_fog"] * 2 + ["cheap_dashcam"] * 2
    for row, (low, high) in zip(results["levels"], [(500, 1000), (20, 40), (-0.1, -0.03), (-0.6, -0.45)], strict=True):
        assert low <= row["value"] <= high
        assert row["num_images"] == 4
    # A lens keeps the square in one piece, and its label moves with it.
    assert [row["score"] for row in results["levels"][2:]] == [1, 1]
    assert complete["report.html"].count(b"data:image/jpeg;base64,") == 2  # of the fog; the lens takes nothing
    kill(tmp_path / "out")
    assert score(*words).code == 0
    assert contents(tmp_path / "out") == complete


def test_worst_cases_stand_in_the_tables_and_the_report_and_continue_with_equal_bytes(score, tmp_path, frames):
    words = ("model=bright:brightness", "labels=coco.json", "score=bright:darkness")
    words += ("scene=[cape_town_fog,cheap_dashcam]", "severity=[1,3]")
    search = ("worst_case=true", "worst_case_draws=3")
    outcome = score(*words, *search)
    assert outcome.code == 0, outcome.err
    complete = contents(tmp_path / "out")
    results = json.loads(complete["results.json"])
    table = list(csv.DictReader(complete["results.csv"].decode().splitlines()))
    scores = [json.loads(line) for line in complete["scores.jsonl"].splitlines()[1:]]
    for i, (row, cells) in enumerate(zip(results["levels"], table, strict=True)):
        worst = [of["levels"][i][2][3] for of in scores]
        assert all(low <= of["levels"][i][2][0] for low, of in zip(worst, scores, strict=True))
        assert row["worst_case"] == float(cells["worst_case"]) == pytest.approx(np.mean(worst))
        assert row["worst_case_low"] <= row["worst_case"] <= row["worst_case_high"]
    fog, lens = results["levels"][:2], results["levels"][2:]
    assert all(row["worst_case"] < row["score"] for row in fog)
    by_scene = results["worst_case"]
    assert list(by_scene) == ["cape_town_fog", "cheap_dashcam", "all scenes"]
    for rows, of in zip((fog, lens, fog + lens), by_scene.values(), strict=True):
        assert of["mean_performance"] == pytest.approx(np.mean([row["score"] for row in rows]))
        assert of["worst_case"] == pytest.approx(np.mean([row["worst_case"] for row in rows]))
    assert results["about"]["worst_case_draws"] == 3
    page = complete["report.html"].decode()
    for row in results["levels"]:
        cells = [row["scene"], str(row["severity"]), f"{row['score']:.3f}"]
        assert "".join(f"<td>{cell}</td>" for cell in cells) in page
        assert f"<td>{row['worst_case']:.3f}</td>" in page
    means = by_scene["cape_town_fog"]
    line = f"<td>cape_town_fog</td><td>{means['mean_performance']:.3f}</td><td>{means['worst_case']:.3f}</td>"
    assert line in page
    text = f"mean score {means['mean_performance']:.3f}, of the worst of 3 draws {means['worst_case']:.3f}"
    assert f"cape_town_fog: {text}\n" in outcome.out
    # Each picture is that of its worst draw, since the score of an image is 1 less its mean.
    pictures = re.findall(r"base64,([^\"]+)\"><figcaption>([^<]+)<", page)
    for data, caption in pictures:
        ((name, scene, worst),) = re.findall(r"^(.+), (\w+) 3: .+ clean, (.+) in the worst case$", caption)
        (of,) = [of["levels"] for of in scores if of["name"] == name]
        lowest = next(values[3] for *level, values in of if level == [scene, 3])
        assert worst == f"{lowest:.2f}"
        mean = np.asarray(Image.open(io.BytesIO(base64.b64decode(data)))).mean() / 255
        assert abs(1 - mean - lowest) < 0.002
    assert pictures
    kill(tmp_path / "out")
    for other in ((), ("worst_case=true",)):
        message = score(*words, *other).err.splitlines()[-1]
        assert message.endswith("of the same settings, got one with worst_case_draws=3; choose another")
    assert score(*words, *search).code == 0
    assert contents(tmp_path / "out") == complete


def test_a_run_without_worst_cases_has_none_and_continues_one_of_an_earlier_version(score, tmp_path, frames):
    assert score(DETECT, *DASHCAM).code == 0
    complete = contents(tmp_path / "out")
    assert all(b"worst_case_low" not in complete[name] for name in ("results.csv", "results.json"))
    assert b"worst case" not in complete["report.html"]
    path = tmp_path / "out" / "scores.jsonl"
    settings, *lines = [json.loads(line) for line in path.read_text().splitlines()]
    for name in ("worst_case_draws", "camera", "horizon"):  # 0.2.0 had none, and three numbers for each score
        del settings[name]
    for of in lines:
        of |= {"clean": of["clean"][:3], "levels": [[*level, numbers[:3]] for *level, numbers in of["levels"]]}
    path.write_text("".join(json.dumps(row) + "\n" for row in [settings, *lines]))
    assert score(DETECT, *DASHCAM).code == 0
    assert (tmp_path / "out" / "results.csv").read_bytes() == complete["results.csv"]


def test_pictures_of_one_name_in_two_folders_have_labels_of_their_own_and_yolo_files_are_read(score, tmp_path, frames):
    labels = tmp_path / "labels"
    for folder, i in (("left", 0), ("right", 3)):
        (frames / folder).mkdir()
        (labels / folder).mkdir(parents=True)
        (frames / f"{i} a=b.png").rename(frames / folder / "same.png")
        x, y = (50 + 10 * i) / 128, 40 / 72
        (labels / folder / "same.txt").write_text(f"1 {x} {y} {20 / 128} {20 / 72}\n")
    for path in frames.glob("*.png"):
        path.unlink()
    words = (DETECT, "labels=labels", *DASHCAM)
    assert "2 pictures, clean score 1.000" in score(*words).out
    (labels / "left" / "same.txt").write_text("1 0.1 0.1 0.1 0.1\n")
    assert score(*words).message.startswith("out must be a folder of the same settings, got one with labels=")
    assert "clean score 0.500" in score(*words, out="o2").out
    (labels / "right" / "same.txt").unlink()  # an empty road, on which the model sees something
    message = score(*words, out="o3").message
    assert message == "model must score above 0 on a clean picture, got 0 on all: check labels and classes"


def test_a_depth_that_is_assumed_is_said(score, frames):
    assert "assumes the depth of a road between walls" in score(DETECT, "scene=cape_town_fog", "severity=1").err
    assert score(DETECT, *DASHCAM, out="o2").err == ""


def test_depth_maps_of_the_pictures_are_taken(score, results, tmp_path, frames):
    for folder, meters in (("near", 1), ("far", 40)):
        for path in frames.iterdir():
            target = DepthFolder(tmp_path / folder).path(path.name)
            target.parent.mkdir(exist_ok=True)
            write_depth(target, torch.full((72, 128), float(meters)))
    words = (DETECT, "scene=cape_town_fog", "severity=4", "labels=coco.json")
    for depth, expected in (("near", 1), ("far", 0)):  # the square is seen through 1 m of fog, and not through 40 m
        assert score(*words, f"depth={depth}", out=f"of_{depth}").err == ""
        assert results(f"of_{depth}")["levels"][0]["score"] == expected
    (tmp_path / "far" / "0 a=b.png").unlink()
    assert "depth must" in score(*words, "depth=far", out="o3").message


def test_other_settings_in_the_same_folder_are_refused(score, frames):
    assert score(DETECT, "scene=[cheap_dashcam]", "severity=[1]").code == 0
    message = score(DETECT, "scene=[cheap_dashcam]", "severity=[2]").message
    assert message == "out must be a folder of the same settings, got one with severity=[1]; choose another"


def test_predictions_of_clean_pictures_stand_for_labels_and_a_function_for_the_score(score, frames):
    outcome = score(DETECT, "score=bright:count", "scene=cheap_dashcam", "severity=5", "limit=2")
    assert "2 pictures, clean score 1.000" in outcome.out
    assert "without labels, a score is the agreement with the prediction for the clean picture\n" in outcome.out
    assert "cheap_dashcam: loses at most 10% even at the strongest tested value, k1 -0." in outcome.out


def test_a_model_that_detects_nothing_in_clean_pictures_has_no_agreement(score, tmp_path, frames):
    for path in frames.iterdir():
        save_picture(path, np.full((72, 128, 3), 90, np.uint8))
    message = score(DETECT, "scene=cheap_dashcam", "severity=5").message
    assert message.startswith(
        "model must detect something with a score of at least 0.5 in a clean picture, got nothing"
    )
    assert not list(tmp_path.glob("out/results*"))


def test_masks_of_0_and_255_whose_255_is_not_scored_are_warned_of(score, tmp_path, frames):
    mask = np.zeros((72, 128), np.uint8)
    for value, is_warned in ((255, True), (1, False)):
        mask[:, 64:] = value
        for path in frames.iterdir():
            save_picture(tmp_path / "masks" / path.name, mask)
        outcome = score("model=bright:segment", *DASHCAM, "labels=masks", out=f"out{value}")
        assert outcome.code == 0, outcome.err
        assert ("at most one class beside 255, which is not scored, so that the scores say" in outcome.err) == is_warned


def test_masks_and_modules_are_taken(score, tmp_path, frames):
    for path in frames.iterdir():
        save_picture(tmp_path / "masks" / path.name, np.zeros((72, 128), np.uint8))
        save_picture(tmp_path / "deep" / path.name, np.zeros((72, 128), np.uint16))
    first = score("model=bright:segment", *DASHCAM, "labels=masks").out
    assert re.search(r"4 pictures, clean score (0\.\d+), mIoU \1", first)  # all pictures have the same pixels
    assert score("model=bright:segment", *DASHCAM, "labels=deep", out="o3").out == first.replace("out/", "o3/")
    assert "clean score 1.000" in score("model=bright:network", "scene=cheap_dashcam", out="o2").out


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("model=nothing:here", "model: a function must be package.module:name that can be imported, got nothing:here"),
        ("model=bright", "model must be package.module:name, torchvision:name, transformers:name, "),
        ("model=lost.onnx", "model must be a file that exists, got lost.onnx"),
        ("model=torchvision:no_such_net", "model must be one of torchvision.models.list_models()"),
        ("data=empty", "data must be a folder of pictures, got empty, which holds none"),
        ("labels=bright.py", "labels must be a COCO JSON, or a folder of YOLO files (.txt) or masks (.png)"),
        ("labels=few.json", "labels must list each picture, got nothing for 0 a=b.png, 1 a=b.png"),
        ("labels=outline.json", "labels must have a bbox and a category_id that is a whole number in each"),
        ("labels=names.json", "labels must have a bbox and a category_id that is a whole number in each"),
        ("scene=[cape_town_frog]", "scene must be some of cheap_dashcam, cape_town_fog"),
        ("severity=[6]", "severity must be some of (1, 2, 3, 4, 5), got [6]"),
        ("severity=true", "severity must be some of (1, 2, 3, 4, 5), got [True]"),
        ("severity=[2.5]", "severity must be some of (1, 2, 3, 4, 5), got [2.5]"),
        ("scene=null", "scene must be some of cheap_dashcam, cape_town_fog"),
        ("device=tpu", "device must be auto, cpu or another device of this machine, got tpu"),
        ("out=coco.json", "out must name what can be read or written, got coco.json: Not a directory"),
        ("model=damaged.pt", "model must be a TorchScript file of torch.jit.save, got damaged.pt (it is no ZIP"),
        ("model=damaged.pt2", "model must be a program of torch.export or ONNX, got damaged.pt2 (it is no ZIP"),
        ("model=damaged.onnx", "model must be a program of torch.export or ONNX, got damaged.onnx ("),
        ("score=bright:nobody", "score must return a number in [0, 1], got None"),
        ("model=bright:one", "predict must return a sequence of one prediction for one image, got dict"),
        ("model=bright:none", "predict must return a sequence of one prediction for one image, got NoneType"),
        ("loss=2", "loss must"),
        ("worst_case=7", "worst_case must be True or False, got 7"),
        ("worst_case_draws=1", "worst_case_draws must be at least 2, got 1"),
        ("weights=damaged.pt", "model: weights must be a state_dict of resnet18, got damaged.pt ("),
        ("model=bright:one weights=other.pt", "model: weights must be null unless the model is torchvision:name"),
        ("weights=other.pt", "model: weights must be a state_dict of resnet18, got other.pt (Error(s) in loading"),
        ("score=bright:nothing", "score: a function must be package.module:name"),
    ],
)
def test_an_invalid_option_is_one_line_of_error(call, tmp_path, frames, word, message):
    command = {"model": "bright:detect", "data": "frames", "out": "out", "scene": "cheap_dashcam"}
    (tmp_path / "few.json").write_text('{"images": [], "annotations": []}')
    document = json.loads((tmp_path / "coco.json").read_text())
    for name, change in (("outline", {"bbox": []}), ("names", {"category_id": "car"})):
        annotations = [annotation | change for annotation in document["annotations"]]
        (tmp_path / f"{name}.json").write_text(json.dumps(document | {"annotations": annotations}))
    torch.save({}, tmp_path / "other.pt")
    for suffix in (".pt", ".pt2", ".onnx"):
        (tmp_path / f"damaged{suffix}").write_text("nothing")
    command |= {"model": "torchvision:resnet18"} if word.startswith("weights") else {}
    command |= dict(option.split("=") for option in word.split())
    words = (f"{name}={value}" for name, value in command.items())
    assert call("robustness.__main__", *words).message.startswith(message)
    assert not list(tmp_path.glob("out/results*"))


def test_a_model_that_fails_for_one_picture_is_said_and_for_all_stops(score, tmp_path, frames):
    save_picture(frames / "white.png", np.full((72, 128, 3), 255, np.uint8))
    outcome = score(DETECT, *DASHCAM)
    assert "warning: the model failed for white.png, which are left out" in outcome.err
    assert "4 pictures" in outcome.out
    assert b"a white picture" in (tmp_path / "out" / "report.html").read_bytes()
    for path in frames.glob("* a=b.png"):
        path.unlink()
    message = score(DETECT, "scene=cheap_dashcam", out="o2").message
    assert message.endswith("the last was white.png: RuntimeError: a white picture")


@pytest.mark.filterwarnings("ignore:.*deprecated:FutureWarning")  # of TorchScript, which people still have
def test_another_model_under_the_name_of_the_first_is_not_mixed_with_its_scores(score, tmp_path, frames):
    for shift, code in ((0.0, 0), (0.0, 0), (1.0, 1)):
        network = torch.nn.Sequential(torch.nn.AdaptiveAvgPool2d(1), torch.nn.Flatten(), torch.nn.Linear(3, 2))
        for parameter in network.parameters():
            torch.nn.init.constant_(parameter, shift)
        torch.jit.save(torch.jit.script(network), tmp_path / "net.pt")
        outcome = score("model=net.pt", *DASHCAM)
        assert outcome.code == code, outcome.err
    assert "error: out must be a folder of the same settings, got one with files={'net.pt': " in outcome.err


@pytest.mark.parametrize("changed", ["model", "score"])
def test_a_run_is_not_continued_after_a_change_of_the_module_of_its_model_or_score(score, tmp_path, frames, changed):
    names = {"model": f"model_of_{changed}", "score": f"score_of_{changed}"}  # this process has imported the others
    for name in names.values():
        (tmp_path / f"{name}.py").write_text(MODEL)
    words = (f"model={names['model']}:detect", f"score={names['score']}:count", *DASHCAM)
    for text, code in ((MODEL, 0), (MODEL, 0), (MODEL + "# other weights", 1)):
        (tmp_path / f"{names[changed]}.py").write_text(text)
        outcome = score(*words)
        assert outcome.code == code, outcome.err
    assert "out must be a folder of the same settings, got one with files={" in outcome.err


def test_a_file_that_is_no_picture_is_named_and_skipped(score, frames):
    expected = score(DETECT, *DASHCAM).out
    (frames / "empty.png").touch()
    outcome = score(DETECT, *DASHCAM, out="o2")
    assert outcome.out == expected.replace("out/", "o2/")
    assert outcome.err.count("skipped: frames/empty.png is empty (0 bytes)\n") == 1
    for path in frames.glob("* a=b.png"):
        path.unlink()
    *_, message = score(DETECT, *DASHCAM, out="o3").err.splitlines()
    assert message == "error: data must hold a picture that can be read, got frames/empty.png is empty (0 bytes)"


@pytest.mark.filterwarnings("ignore:.*deprecated:FutureWarning")  # of TorchScript, which people still have
def test_exported_programs_and_the_detector_of_opencv_predict(tmp_path):
    network = torch.nn.Sequential(torch.nn.AdaptiveAvgPool2d(1), torch.nn.Flatten(), torch.nn.Linear(3, 2)).eval()
    image = torch.rand(1, 3, 40, 60)
    torch.jit.save(torch.jit.trace(network, image), tmp_path / "net.pt")
    torch.export.save(torch.export.export(network, (image,)), tmp_path / "net.pt2")
    for name in ("net.pt", "net.pt2"):
        torch.testing.assert_close(load_predictor(str(tmp_path / name))(image), network(image).detach())
    (found,) = load_predictor("opencv:hog")(torch.rand(1, 3, 160, 120))
    for size in ((128, 64), (127, 200), (200, 63), (1, 1)):  # smaller images than its window have no pedestrians
        (smaller,) = load_predictor("opencv:hog")(torch.rand(1, 3, *size))
        assert smaller["boxes"].shape == (0, 4)
    assert set(found) == {"boxes", "labels", "scores"}


def test_a_local_state_dict_of_torchvision_is_loaded_without_network(tmp_path):
    network = models.get_model("mobilenet_v3_small", weights=None, num_classes=1000).eval()
    torch.save(network.state_dict(), tmp_path / "weights.pth")
    predict = load_predictor("torchvision:mobilenet_v3_small", weights=str(tmp_path / "weights.pth"))
    image = torch.rand(1, 3, 40, 60)
    assert predict(image).shape == (1, 1000)
    prepare = models.get_model_weights("mobilenet_v3_small")["DEFAULT"].transforms()
    torch.testing.assert_close(predict(image), network(prepare(image)).detach())


@pytest.mark.quick
def test_each_scene_with_a_quantity_has_its_value_in_the_stated_range():
    image = torch.rand(2, 3, 36, 64)
    expected = {
        "cheap_dashcam": (-0.35, -0.15),
        "cape_town_fog": (60, 200),
        "limpopo_sun_glare": (4, 8),
        "highveld_heat_haze": (12, 18),
        "unpaved_road": (60, 200),
    }
    for name in SCENES:
        quantity = quantity_of([getattr(presets, name)(3)])
        assert quantity is not None
        values = quantity.get(getattr(presets, name)(3).sample(image, seed=0))
        assert values.shape == (2,)
        low, high = expected.get(name, (0, 1e6))
        assert ((values >= low) & (values <= high)).all(), name
