"""The page of the playground, made by Gradio."""

import logging
import os
import socket
from collections.abc import Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

os.environ["GRADIO_ANALYTICS_ENABLED"] = "False"  # read at the import of Gradio, which otherwise calls its server

import gradio as gr  # pyright: ignore[reportMissingImports]  # after its setting; in its own extra
from omegaconf import DictConfig, OmegaConf

from torchrefract._validation import UsageError, check_count
from torchrefract.cli.options import read_option
from torchrefract.cli.playground_view import (
    RENDERED_SIZE,
    Slider,
    Sliders,
    Source,
    choices,
    config_of,
    is_scene,
    picture,
    rendered_road,
    sliders_of,
    view,
    with_fixed,
)
from torchrefract.data.images import UnreadableImageError

_HOST = "127.0.0.1"  # this machine alone
_MAX_BYTES = 50 * 1024**2  # of a file
_PORTS = 65535
# The picture stays in view while sliders move: they scroll beside it, or below it in a narrow window.
_STYLE = """
.gradio-container { overflow: visible !important; }
.controls { position: sticky !important; top: 0; max-height: 100vh; flex-wrap: nowrap !important; }
.controls { overflow: hidden auto !important; }
.controls > * { flex-shrink: 0; }
@media (max-width: 720px) {
  .left { display: contents !important; }
  .picture { position: sticky !important; top: 0; z-index: 100; }
  .controls { order: 1; position: static !important; max-height: none; overflow: visible !important; }
  .details { order: 2; }
}
"""
# A browser moves the handle of a slider whose ends change while its value, 0, does not.
_SCRIPT = """() => setInterval(() => document.querySelectorAll(".controls input[type=range]").forEach((slider) => {
  const number = slider.closest(".block").querySelector("input[type=number]");
  if (document.activeElement !== slider && +slider.value !== +number.value) slider.value = number.value;
}), 300)"""


def playground(cfg: DictConfig) -> None:
    """Serve the page until Ctrl-C."""
    port, max_side = (read_option(cfg, name, check_count) for name in ("port", "max_side"))
    _check_free(port)
    sliders: Any = OmegaConf.to_container(cfg.sliders)
    page = make_page(sliders, max_side=max_side)
    logging.getLogger("httpx").setLevel(logging.WARNING)  # Gradio calls its own server once
    launch(page, port, browser=bool(cfg.browser))
    print(f"http://{_HOST}:{port} shows the page; Ctrl-C stops it", flush=True)
    with suppress(KeyboardInterrupt):
        page.block_thread()


def launch(page: gr.Blocks, port: int, *, browser: bool = False) -> None:
    """Serve a page on this machine, in the background."""
    page.launch(
        server_name=_HOST,
        server_port=port,
        inbrowser=browser,
        share=False,
        ssr_mode=False,
        quiet=True,
        prevent_thread_lock=True,
        max_file_size=_MAX_BYTES,
        footer_links=[],
        css=_STYLE,
        js=_SCRIPT,
    )


def make_page(table: Sliders, *, max_side: int) -> gr.Blocks:
    """Build the page.

    Args:
        table: the ends and units of the sliders.
        max_side: px, to which pictures are reduced.
    """

    @lru_cache(maxsize=4)
    def source(path: str | None, road: int) -> Source:
        return rendered_road(road) if path is None else picture(Path(path), max_side=max_side)

    def config(choice: str, severity: int, path: str | None) -> dict[str, Any]:
        width = RENDERED_SIZE[1] if path is None else source(path, 0).image.shape[3]
        return config_of(choice, severity=severity, width=width)

    def show(path: str | None, road: int, choice: str, severity: int, seed: int, key: int, *positions: float) -> Any:
        road, seed, key = (number or 0 for number in (road, seed, key))  # None for an empty field
        try:
            chosen = config(choice, severity, path)
            if positions:
                chosen = with_fixed(chosen, sliders_of(chosen, table), positions)
            seen = view(source(path, road), chosen, seed=seed, key=key)
        except (ValueError, TypeError, OSError) as error:
            remedy = "" if isinstance(error, UnreadableImageError) else "move a slider back, or "
            message = f"{error}; {remedy}choose another picture"
            raise gr.Error(message, duration=None, print_exception=False) from error
        return (seen.before, seen.after), seen.map, seen.about, seen.code, seen.yaml

    with gr.Blocks(title="torchrefract", analytics_enabled=False, delete_cache=(3600, 3600)) as page:
        with gr.Row():
            with gr.Column(scale=3, min_width=320, elem_classes="left"):
                shown = gr.ImageSlider(
                    label="before and after", elem_classes="picture", format="png", interactive=False
                )
                with gr.Column(elem_classes="details"):
                    with gr.Row():
                        image = {"format": "png", "min_width": 300, "interactive": False}
                        drawn_map = gr.Image(label="map", buttons=["download", "fullscreen"], **image)
                        about = gr.Textbox(label="drawn parameters, time and plan", lines=12, min_width=300)
                    with gr.Tab("Python"):
                        code = gr.Code(language="python", label="Python code of the picture", elem_id="code")
                    with gr.Tab("YAML"):
                        yaml = gr.Code(
                            language="yaml", label="YAML, as DIR/scene/NAME.yaml for --config-dir DIR scene=NAME"
                        )
            with gr.Column(scale=1, min_width=320, elem_classes="controls"):
                path = gr.File(label="JPEG, PNG, WebP or BMP up to 50 MB", height=160)
                road = gr.Number(0, label="without a picture, number of the rendered road", precision=0, minimum=0)
                choice = gr.Dropdown(choices(), value="cape_town_fog", label="scene or effect", elem_id="choice")
                severity = gr.Slider(1, 5, 3, step=1, label="severity of the scene", elem_id="severity")
                with gr.Row():
                    seed = gr.Number(0, label="seed", precision=0, minimum=0, min_width=80)
                    key = gr.Number(0, label="key", precision=0, minimum=0, min_width=80)
                given = [path, road, choice, severity, seed, key]
                results = [shown, drawn_map, about, code, yaml]
                shared = {"outputs": results, "concurrency_id": "show", "trigger_mode": "always_last"}

                @gr.render(inputs=[choice, severity, path])
                def draw_sliders(chosen: str, level: int, file: str | None) -> None:
                    try:
                        moving = _draw_sliders(sliders_of(config(chosen, level, file), table))
                    except UnreadableImageError:  # `show` says it
                        return
                    triggers = [part.input for part in (road, seed, key, *moving)]
                    gr.on(triggers, show, inputs=[*given, *moving], **shared)

        choice.change(lambda name: gr.update(visible=is_scene(name)), choice, severity)
        gr.on([page.load, path.change, choice.change, severity.change], show, inputs=given, **shared)
    return page


def _draw_sliders(sliders: Sequence[Slider]) -> list[gr.Slider]:
    drawn, effect = [], None
    for slider in sliders:
        if slider.path[:-1] != effect:
            gr.Markdown(f"**{slider.effect}**")
        effect = slider.path[:-1]
        label = f"{slider.name}, {slider.unit}" if slider.unit else slider.name
        options = {"step": slider.step, "label": label, "info": slider.info, "interactive": True}
        drawn.append(gr.Slider(slider.low, slider.high, slider.start, **options))
    return drawn


def _check_free(port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as the server does, after a page was closed
        try:
            probe.bind((_HOST, port))
        except (OSError, OverflowError) as error:
            other = port + 1 if port < _PORTS else 7860
            raise UsageError(f"port must be free, and at most {_PORTS}, got {port}; try port={other}") from error
