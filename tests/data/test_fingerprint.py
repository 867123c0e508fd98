import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from torch.utils.data import Dataset

from torchrefract.data.frames import FrameFolder
from torchrefract.data.module import fingerprint
from torchrefract.data.pairs.dataset import PairedFolder
from torchrefract.data.road_scenes import RoadScenes
from torchrefract.types import Frame


@pytest.fixture
def frames(tmp_path) -> Path:
    """Write six images of two drives."""
    generator = np.random.default_rng(0)
    for number in range(6):
        path = tmp_path / "frames" / f"drive{number // 3}" / f"{number}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(generator.integers(0, 256, (32, 48, 3)).astype(np.uint8)).save(path)
    return tmp_path / "frames"


def test_the_fingerprint_of_a_folder_hashes_names_and_sizes_of_files(frames):
    result = fingerprint(FrameFolder(frames, size=(16, 24)))
    lines = [f"drive{k // 3}/{k}.png {(frames / f'drive{k // 3}' / f'{k}.png').stat().st_size}\n" for k in range(6)]
    assert result == {
        "source": "FrameFolder",
        "root": str(frames),
        "frames": 6,
        "drives": 2,
        "size": [16, 24],
        "license": None,
        "sha256": hashlib.sha256("".join(lines).encode()).hexdigest(),
    }
    json.dumps(result)


def test_another_file_or_name_changes_the_fingerprint(frames):
    before = fingerprint(FrameFolder(frames, size=(16, 24)))["sha256"]
    assert fingerprint(FrameFolder(frames, size=(32, 48)))["sha256"] == before
    (frames / "drive0" / "0.png").rename(frames / "drive0" / "9.png")
    renamed = fingerprint(FrameFolder(frames, size=(16, 24)))["sha256"]
    with (frames / "drive0" / "9.png").open("ab") as stream:
        stream.write(b"more")
    assert len({before, renamed, fingerprint(FrameFolder(frames, size=(16, 24)))["sha256"]}) == 3


def test_the_fingerprint_of_pairs_hashes_checksums_and_has_the_license(call, frames):
    words = ("scene=paper_weather", f"source={frames}", "license=CC0", "workers=0")
    for out, seed in (("one", 0), ("same", 0), ("other", 1)):
        assert call("generate", *words, f"out={out}", f"seed={seed}").code == 0
    one, same, other = (fingerprint(PairedFolder(frames.parent / name)) for name in ("one", "same", "other"))
    assert (one["frames"], one["drives"], one["size"], one["license"]) == (6, 2, [32, 48], "CC0")
    assert one["sha256"] == same["sha256"] != other["sha256"]
    (frames.parent / "one" / "config.json").write_text("damaged")
    assert fingerprint(PairedFolder(frames.parent / "one")) == one | {"license": None}
    train = fingerprint(PairedFolder(frames.parent / "one", split="train"))
    assert (train["frames"], train["drives"]) == (3, 1)


def test_the_fingerprint_of_road_scenes_hashes_their_arguments():
    result = fingerprint(RoadScenes(4, size=(16, 24)))
    assert (result["root"], result["drives"], result["frames"], result["size"]) == (None, None, 4, [16, 24])
    others = [RoadScenes(4, size=(16, 24), first=1), RoadScenes(4, size=(16, 24), seed=1), RoadScenes(5, size=(16, 24))]
    assert len({result["sha256"], *(fingerprint(other)["sha256"] for other in others)}) == 4


def test_the_fingerprint_of_another_dataset_has_its_class_and_length():
    class Custom(Dataset[Frame]):
        """Two frames."""

        def __len__(self) -> int:
            return 2

        def __getitem__(self, index: int) -> Frame:
            return RoadScenes(2, size=(16, 24))[index]

    result = fingerprint(Custom())
    assert (result["source"], result["frames"], result["size"], result["root"]) == ("Custom", 2, [16, 24], None)
