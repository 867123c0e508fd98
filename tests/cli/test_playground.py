"""The playground: sliders, code and YAML, and the page in a real browser."""

import importlib
import inspect
import json
import re
import shutil
import socket
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hydra.utils import instantiate
from omegaconf import OmegaConf
from pictures import save_picture, smooth_picture
from PIL import Image
from processes import running

import torchrefract as tr
from torchrefract._io import CONFIG_DIR
from torchrefract.cli import playground_view
from torchrefract.cli.entry import missing_library
from torchrefract.cli.playground_view import choices, config_of, is_scene, picture, sliders_of, view, with_fixed
from torchrefract.data.images import UnreadableImageError
from torchrefract.effects.base import Effect

_CONFIG: Any = OmegaConf.to_container(OmegaConf.load(Path(CONFIG_DIR, "playground.yaml")))
TABLE = _CONFIG["sliders"]
OF_CLIPS = re.compile(r"(wind_.|drift_.|decorrelation|rate|time_constant)_range")  # mean nothing for one frame


def write_picture(path: Path, height: int = 48, width: int = 96) -> Path:
    save_picture(path, smooth_picture(height, width))
    return path


@pytest.mark.quick
def test_every_parameter_of_a_frame_has_a_slider_and_no_other():
    for name in tr.__all__:
        kind: Any = getattr(tr, name)
        if inspect.isclass(kind) and issubclass(kind, Effect):
            ranges = {argument for argument in inspect.signature(kind).parameters if argument.endswith("_range")}
            assert {*TABLE.get(name, {})} == {word for word in ranges if not OF_CLIPS.fullmatch(word)}, name


@pytest.mark.quick
@pytest.mark.parametrize("choice", choices())
def test_the_ends_of_a_slider_hold_the_range_of_each_severity(choice):
    for severity in range(1, 6) if is_scene(choice) else (3,):
        sliders = sliders_of(config_of(choice, severity=severity, width=1920), TABLE)
        assert sliders
        for slider in sliders:
            drawn = [float(word) for word in slider.info.removesuffix(" until moved").split(" to ") if word != "off"]
            lowest, highest = sorted(slider.value(end) for end in (slider.low, slider.high))
            assert all(lowest <= end <= highest for end in drawn), slider
            assert slider.low <= slider.start <= slider.high


def test_a_moved_slider_fixes_its_parameter_and_leaves_the_draws_of_the_others(tmp_path):
    source = picture(write_picture(tmp_path / "a.png"), max_side=96)
    config = config_of("cape_town_fog", severity=3, width=96)
    sliders = sliders_of(config, TABLE)
    starts = [slider.start for slider in sliders]
    assert with_fixed(config, sliders, starts) is config
    fixed = with_fixed(config, sliders, [64.0, *starts[1:]])
    assert sliders[0].name == "visibility"
    options: dict[str, Any] = {"seed": 3, "keys": [5]}
    before, after = (instantiate(of).sample(source.image, **options) for of in (config, fixed))
    assert after.visibility.item() == 64.0 != before.visibility.item()
    assert (after.contrast, after.deviation) == (before.contrast, before.deviation)


@pytest.mark.parametrize(
    ("choice", "name", "position"),
    [
        ("cape_town_fog", None, 0),
        ("unpaved_road", "speed", 120),
        ("paper_refractive", "k1", -0.5),
        ("PhysicalTurbulence", "cn2", -9.5),
        ("highveld_telephoto", "cn2", -10.5),
        ("SunGlare", "center x", 0.9),
    ],
)
@pytest.mark.filterwarnings("ignore:depth is that of a road")  # the test is of the code
def test_the_code_and_the_yaml_make_the_picture_that_is_seen(choice, name, position, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    source = picture(write_picture(tmp_path / "Größe 1.png", 60, 120), max_side=96)
    config = config_of(choice, severity=4, width=96)
    sliders = sliders_of(config, TABLE)
    positions = [position if slider.name == name else slider.start for slider in sliders]
    seen = view(source, with_fixed(config, sliders, positions), seed=7, key=2)
    assert seen.after.shape == (48, 96, 3)
    assert not np.array_equal(seen.before, seen.after)
    exec(compile(seen.code, "copied", "exec"), {})
    assert np.array_equal(np.asarray(Image.open("degraded.png")), seen.after)
    again = instantiate(OmegaConf.create(seen.yaml)).degrade(source.image, seed=7, keys=[2])
    assert np.array_equal(playground_view.pixels_of(again.image[0]), seen.after)


@pytest.mark.filterwarnings("ignore:depth is that of a road")  # the view repeats it
def test_a_view_shows_both_maps_the_plan_the_time_and_warnings(tmp_path):
    source = picture(write_picture(tmp_path / "a.png"), max_side=96)
    dust, lens = (
        view(source, config_of(name, severity=3, width=96), seed=0, key=0) for name in ("unpaved_road", "cheap_dashcam")
    )
    assert dust.map is not None
    assert lens.map is not None
    assert dust.map.shape[0] > 1.5 * lens.map.shape[0]  # a flow and a transmission
    assert re.search(r"HeterogeneousFog \(visibility [0-9.]+ m", dust.about)
    assert re.search(r"\n\d+ ms for 96x48 px; a first run compiles\nWarning: depth is that of a road", dust.about)
    assert "error at most" in lens.about
    assert "Warning" not in lens.about


@pytest.mark.filterwarnings("ignore:depth is that of a road")  # the test is of the legend
def test_the_legend_of_the_map_of_an_upright_picture_ends_within_it(tmp_path):
    source = picture(write_picture(tmp_path / "a.png", 192, 96), max_side=192)
    drawn = view(source, config_of("cape_town_fog", severity=3, width=96), seed=0, key=0).map
    assert drawn is not None
    assert (drawn[:, -8:] == 255).all()


@pytest.mark.quick
def test_what_is_no_picture_is_named_without_its_folder(tmp_path):
    (tmp_path / "text.png").write_text("no picture")
    with pytest.raises(UnreadableImageError, match=r"^text\.png is not a JPEG, PNG, WebP or BMP image$"):
        picture(tmp_path / "text.png", max_side=96)


@pytest.mark.quick
def test_without_gradio_the_error_names_the_extra():
    error = ModuleNotFoundError("No module named 'gradio'", name="gradio")
    expected = "playground needs gradio, which is not installed: pip install 'torchrefract[playground]'"
    assert missing_library(error, "playground") == expected


_SHOW = """from torchrefract.cli.playground import make_page
show = next(of.fn for of in make_page({}, max_side=96).fns.values() if of.name == "show")
print(show(None, None, "Vignetting", 3, None, None)[3])
"""


def test_an_empty_number_is_0_so_that_the_copied_code_makes_the_picture(spawn, tmp_path):
    pytest.importorskip("gradio", reason="gradio is in the extra playground")
    code = spawn("-c", _SHOW, cwd=tmp_path).out
    assert "torch.tensor([0])" in code
    assert "seed=0, keys=[0]" in code


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Iterator[str]:
    """Serve the page by its command, without a proxy or a network; return its address."""
    pytest.importorskip("gradio", reason="gradio is in the extra playground")
    port, folder = free_port(), tmp_path_factory.mktemp("page")
    words = ["-m", "torchrefract.playground", f"port={port}", "browser=false"]
    with running(*words, cwd=folder, stdout=subprocess.PIPE) as server:
        assert server.stdout is not None
        assert f"http://127.0.0.1:{port} shows the page" in server.stdout.readline()
        yield f"http://127.0.0.1:{port}"
        server.terminate()


@pytest.fixture
def browser(tmp_path) -> Iterator[Any]:
    """Start Chromium without a network but for this machine."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    program, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if program is None or driver is None:
        pytest.skip("chromium and chromedriver are not installed")
    options = webdriver.ChromeOptions()
    options.binary_location = program
    words = ["headless", "no-sandbox", "disable-gpu", "disable-quic", "no-first-run", "disable-background-networking"]
    words += ["disable-component-update", "disable-sync", f"user-data-dir={tmp_path / 'profile'}"]
    for word in [*words, "host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1", "window-size=1440,1400"]:
        options.add_argument(f"--{word}")
    options.set_capability("goog:loggingPrefs", {"performance": "ALL"})
    chromium = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    chromium.set_script_timeout(20)
    yield chromium
    chromium.quit()


def wait_for(condition: Callable[[], Any], what: str) -> Any:
    """Return the first true value of a function; a page replaces its elements meanwhile."""
    exceptions = importlib.import_module("selenium.common.exceptions")
    end = time.monotonic() + 120
    while time.monotonic() < end:
        with suppress(exceptions.WebDriverException):
            if value := condition():
                return value
        time.sleep(0.2)
    raise AssertionError(f"the page showed no {what} in two minutes")


def test_in_a_browser_a_moved_slider_shows_another_picture_and_the_copied_code_makes_it(page, browser, spawn, tmp_path):
    file = write_picture(tmp_path / "frame.png", 120, 200)

    def pictures() -> list[str]:
        images = browser.find_elements("css selector", ".picture img")
        return [image.get_attribute("src") for image in images] if len(images) == 2 else []

    browser.get(page)
    road = wait_for(pictures, "rendered road")
    browser.find_element("css selector", "input[type=file]").send_keys(str(file))
    drawn = wait_for(lambda: (seen := pictures()) and seen[0] != road[0] and seen, "uploaded picture")
    slider = wait_for(
        lambda: browser.find_element("css selector", "input[type=range][aria-label*='visibility']"), "slider"
    )
    slider.send_keys("\ue012" * 5)  # the arrow to the left
    moved = wait_for(lambda: (seen := pictures()) and seen[1] != drawn[1] and seen, "other picture")
    assert moved[0] == drawn[0]
    # Until the picture rests:
    wait_for(lambda: (last := pictures()) and not time.sleep(1) and last == pictures(), "picture that rests")
    grant = {"permissions": ["clipboardReadWrite", "clipboardSanitizedWrite"], "origin": page}
    browser.execute_cdp_cmd("Browser.grantPermissions", grant)
    # While the server computes, a cover of the page takes the click.
    wait_for(lambda: browser.find_element("css selector", "#code button[title=Copy]").click() or True, "button")
    read = "const done = arguments[0]; setTimeout(() => navigator.clipboard.readText().then(done), 500)"
    code = browser.execute_async_script(read)
    assert "visibility_range=(" in code
    assert spawn("-c", code, cwd=tmp_path).code == 0
    with urllib.request.urlopen(pictures()[1]) as answer:
        (tmp_path / "seen.png").write_bytes(answer.read())
    seen, made = (np.asarray(Image.open(tmp_path / name)) for name in ("seen.png", "degraded.png"))
    assert np.array_equal(seen, made)
    messages = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    urls = [m["params"]["request"]["url"] for m in messages if m["method"] == "Network.requestWillBeSent"]
    assert [url for url in urls if not url.startswith((page, "data:", "blob:", "chrome"))] == []


def test_a_file_that_is_no_picture_and_one_that_is_too_large_are_one_line_on_the_page(page, browser, tmp_path):
    (tmp_path / "text.png").write_text("no picture")
    with (tmp_path / "large.png").open("wb") as file:
        file.truncate(51 * 1024**2)
    browser.get(page)
    for name, message in (
        ("text.png", "text.png is not a JPEG, PNG, WebP or BMP image; choose another picture"),
        ("large.png", 'exceed the maximum allowed size of 50.0 Mb: "large.png"'),
    ):
        wait_for(lambda: browser.find_element("css selector", "input[type=file]"), "file input").send_keys(
            str(tmp_path / name)
        )
        toast = wait_for(lambda: browser.find_element("css selector", ".toast-message-text").text, "message")
        assert message in toast
        browser.get(page)


def test_a_port_in_use_is_one_line_with_another_port(call):
    pytest.importorskip("gradio", reason="gradio is in the extra playground")
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        assert call("playground", f"port={port}").message.startswith(
            f"port must be free, and at most 65535, got {port}"
        )
    assert call("playground", "port=0").message == "port must be at least 1, got 0"
