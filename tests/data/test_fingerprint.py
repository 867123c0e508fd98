import hashlib
import json
import shutil

from torch.utils.data import Dataset

from torchrefract.data.frames import FrameFolder
from torchrefract.data.module import fingerprint
from torchrefract.data.pairs.dataset import PairedFolder
from torchrefract.data.road_scenes import RoadScenes
from torchrefract.types import Frame


def test_the_fingerprint_of_a_folder_hashes_names_and_sizes_of_files(frames, tmp_path):
    result = fingerprint(FrameFolder(frames, size=(16, 24)))
    names = [f"drive{k // 4}/{k:03d}.png" for k in range(12)]
    lines = [f"{name} {(frames / name).stat().st_size}\n" for name in names]
    assert result == {
        "source": "FrameFolder",
        "root": str(frames),
        "frames": 12,
        "drives": 3,
        "size": [16, 24],
        "license": None,
        "sha256": hashlib.sha256("".join(lines).encode()).hexdigest(),
    }
    json.dumps(result)
    root = shutil.copytree(frames, tmp_path / "frames")
    assert fingerprint(FrameFolder(root, size=(32, 48)))["sha256"] == result["sha256"]
    (root / "drive0" / "000.png").rename(root / "drive0" / "099.png")
    renamed = fingerprint(FrameFolder(root, size=(16, 24)))["sha256"]
    with (root / "drive0" / "099.png").open("ab") as stream:
        stream.write(b"more")
    assert len({result["sha256"], renamed, fingerprint(FrameFolder(root, size=(16, 24)))["sha256"]}) == 3


def test_the_fingerprint_of_pairs_hashes_checksums_and_has_the_license(call, words, tmp_path):
    for out, seed in (("one", 0), ("same", 0), ("other", 1)):
        assert call("generate", *words(out, "count=6", f"seed={seed}", scene="paper_weather")).code == 0
    one, same, other = (fingerprint(PairedFolder(tmp_path / name)) for name in ("one", "same", "other"))
    assert (one["frames"], one["drives"], one["size"], one["license"]) == (6, 3, [32, 48], "CC0")
    assert one["sha256"] == same["sha256"] != other["sha256"]
    (tmp_path / "one" / "config.json").write_text("damaged")
    assert fingerprint(PairedFolder(tmp_path / "one")) == one | {"license": None}
    val = fingerprint(PairedFolder(tmp_path / "one", split="val"))
    assert (val["frames"], val["drives"]) == (2, 1)


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
