import errno
from pathlib import Path

import pytest

from torchrefract._io import as_path, replace_file, write_file


def test_the_old_file_stays_until_the_new_one_is_complete(tmp_path):
    path, plain = tmp_path / "panel.png", tmp_path / "plain"
    path.write_text("old")
    plain.write_text("")
    with replace_file(path) as temporary:
        temporary.write_text("new")
        assert path.read_text() == "old"
        assert (temporary.parent, temporary.suffix) == (path.parent, path.suffix)
    assert path.read_text() == "new"
    assert sorted(tmp_path.iterdir()) == [path, plain]
    assert path.stat().st_mode == plain.stat().st_mode  # of the umask


@pytest.mark.quick
@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_a_failure_keeps_the_old_file_and_deletes_the_temporary_one(tmp_path, error):
    path = tmp_path / "panel.png"
    path.write_text("old")

    def fail():
        with replace_file(path) as temporary:
            temporary.write_text("half")
            raise error

    with pytest.raises(error):
        fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("alone", [False, True])
def test_a_name_of_the_longest_length_is_written(tmp_path, alone):
    path = tmp_path / ("\udcffü" + "a" * 248 + ".png")  # of 255 bytes
    write_file(path, "new", alone=alone)
    assert path.read_text() == "new"


@pytest.mark.parametrize("is_named", [False, True])
def test_an_error_of_writing_names_the_file(tmp_path, is_named):
    with (
        pytest.raises(OSError, match=r"No space left on device: '.*/panel.png'$"),
        replace_file(tmp_path / "panel.png") as temporary,
    ):
        raise OSError(errno.ENOSPC, "No space left on device", str(temporary) if is_named else None)


def test_a_report_may_hold_names_of_files_that_are_no_unicode(tmp_path):
    write_file(tmp_path / "report.html", "Zürich/\udcff.png")
    assert (tmp_path / "report.html").read_text(encoding="utf-8") == "Zürich/\\udcff.png"


def test_a_block_that_writes_nothing_raises(tmp_path):
    with pytest.raises(FileNotFoundError), replace_file(tmp_path / "panel.png"):
        pass


@pytest.mark.parametrize("text", ["s3:/bucket/pairs", "gs:/a", "memory:/x", "file:/a", "S3:/a"])
def test_an_address_with_one_slash_raises_instead_of_naming_a_folder(text):
    with pytest.raises(ValueError, match=f"an address must have two slashes behind its scheme, got {text}; write "):
        as_path(text)
    assert as_path("cam:/x") == Path("cam:/x")
