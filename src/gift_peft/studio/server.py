"""The studio's page: the rooms as tabs of one gradio page, served to this computer alone.

Nothing is sent anywhere, and nothing is loaded from elsewhere: the server binds to 127.0.0.1, answers no request that
another site's page makes, and a Content-Security-Policy tells the browser the same. No file is served but what the
rooms put into a temporary folder of this run.
"""

import logging
import os
import signal
import socket
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import wraps
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

from gift_peft.files import printable

if TYPE_CHECKING:  # each brings its own heavy packages
    from gift_peft.studio.capture_room import CaptureRoom
    from gift_peft.studio.compare_room import CompareRoom
    from gift_peft.studio.mask_room import MaskRoom
    from gift_peft.studio.target_room import TargetRoom

PAGE = Path(__file__).parent / "page"
HOST = "127.0.0.1"
# What the page asks for, by the beginning of the path; gradio has many more routes.
ROUTES = (
    *("/assets/", "/static/", "/config", "/theme.css", "/favicon.ico", "/manifest.json", "/gradio_api/startup-events"),
    *("/gradio_api/queue/", "/gradio_api/heartbeat/", "/gradio_api/component_server", "/gradio_api/upload"),
    *("/gradio_api/theme.css", "/gradio_api/app_id", "/gradio_api/info", "/gradio_api/cancel", "/gradio_api/reset"),
)
FILES = "/gradio_api/file="
POLICY = (
    "default-src 'self' data: blob: 'unsafe-inline' 'unsafe-eval'; connect-src 'self' data: blob:; object-src 'none'; "
    "base-uri 'self'; form-action 'self'; frame-ancestors 'none'"
)
LARGEST_PHOTO = "100mb"
# The viewer of points tries WebGPU first and complains where a browser has it without a device; WebGL does as well.
HEAD = "<script>delete Navigator.prototype.gpu;</script>"
# On a telephone, too, all rooms have their tab in sight.
HEAD += "<style>@media (max-width: 600px) { .tab-container button { padding: 0 .4rem !important } }</style>"


@dataclass
class Rooms:
    """What there is to show; None where a room has nothing, and `lacking` says what it needs."""

    capture: "CaptureRoom | None" = None
    masks: "MaskRoom | None" = None
    targets: "TargetRoom | None" = None
    compare: "CompareRoom | None" = None


LACKING = {
    "Capture": "Photos are taken by a camera of this computer, a stream or a clip, which you name: "
    "`gift-peft studio RAW --source 0`. RAW may be a new folder.",
    "Masks": "Masks are drawn on a raw tree, the folder of photos or clips: `gift-peft studio RAW`.",
    "Targets": "Surface targets are shown of a prepared folder: `gift-peft studio OUT`, after "
    "`gift-peft proxies --base BASE --dataset OUT --target surface`.",
    "Compare": "Base and adapter are compared where there is one: `gift-peft studio RUN`, or `--adapter ADAPTER` "
    "with any folder.",
}


def check_gradio() -> None:
    """ValueError, with the command to type, where gradio is not installed."""
    if find_spec("gradio") is None:
        raise ValueError('the studio needs gradio: pip install "gift-peft[studio]"')


def free_port(port: int) -> int:
    """The port itself, or for 0 one that is free; ValueError if another program has it."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except (OSError, OverflowError):
            raise ValueError(
                f"port {port} cannot be used, perhaps another studio has it: name another with --port, or --port 0"
            ) from None
        return probe.getsockname()[1]


@contextmanager
def private_folder() -> Iterator[Path]:
    """A temporary folder of this run, in which gradio too keeps what it serves; before gradio is imported."""
    with tempfile.TemporaryDirectory(prefix="gift-peft-studio-") as folder:
        os.environ["GRADIO_TEMP_DIR"] = str(Path(folder) / "gradio")
        os.environ["GRADIO_ANALYTICS_ENABLED"] = "False"
        for name in ("no_proxy", "NO_PROXY"):  # gradio asks its own server whether it is up, which no proxy can reach
            os.environ[name] = ",".join(filter(None, (os.environ.get(name), HOST)))
        yield Path(folder)


class Guard:
    """In front of gradio: requests of this page alone, for what it needs, and for files of the private folder."""

    def __init__(self, app: Any, port: int, folder: Path) -> None:
        self.app, self.folder = app, Path(os.path.realpath(folder))
        # Browsers leave :80 out.
        self.hosts = {f"{name}:{port}".removesuffix(":80") for name in (HOST, "localhost")}

    async def __call__(self, scope: dict, receive: Any, send: Any) -> None:
        if scope["type"] == "lifespan":
            return await self.app(scope, receive, send)
        headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}
        if scope["type"] != "http" or not self._allows(scope["path"], headers):
            return await _refuse(scope, send)

        async def with_policy(message: dict) -> None:
            if message["type"] == "http.response.start":
                more = {"content-security-policy": POLICY, "referrer-policy": "no-referrer"}
                pairs = [(name.encode(), value.encode()) for name, value in more.items()]
                message = {**message, "headers": [*message.get("headers", []), *pairs]}
            await send(message)

        return await self.app(scope, receive, with_policy)

    def _allows(self, path: str, headers: dict[str, str]) -> bool:
        """Host and origin are this page's (a site that calls itself 127.0.0.1 has another name in `host`)."""
        own = headers.get("host") in self.hosts
        origin = headers.get("origin")
        if not own or (origin is not None and origin.removeprefix("http://") not in self.hosts):
            return False
        if path.startswith(FILES):
            file = os.path.realpath(unquote(path.removeprefix(FILES)))
            return Path(file).is_relative_to(self.folder)
        return ".." not in path.split("/") and (path == "/" or path.startswith(ROUTES))


async def _refuse(scope: dict, send: Any) -> None:
    if scope["type"] == "websocket":
        return await send({"type": "websocket.close", "code": 1008})
    await send({"type": "http.response.start", "status": 403, "headers": [(b"content-type", b"text/plain")]})
    await send({"type": "http.response.body", "body": b"not served"})


def build(rooms: Rooms, title: str) -> Any:
    """The gradio page; the first room that has something is open."""
    import gradio as gr

    tabs = {"Capture": rooms.capture, "Masks": rooms.masks, "Targets": rooms.targets, "Compare": rooms.compare}
    fill = {"Capture": _capture_tab, "Masks": _masks_tab, "Targets": _targets_tab, "Compare": _compare_tab}
    first = next(name for name, room in tabs.items() if room is not None)
    with gr.Blocks(title=title, analytics_enabled=False) as blocks:
        gr.Markdown(f"# {title}")
        with gr.Tabs(selected=first):
            for name, room in tabs.items():
                with gr.Tab(name, id=name):
                    if room is None:
                        gr.Markdown(LACKING[name])
                    else:
                        fill[name](gr, room, blocks)
    return blocks


def serve(blocks: Any, port: int, folder: Path, opened: bool, ready: Callable[[str], None]) -> None:
    """Serve the page until Ctrl-C, or SIGTERM; `ready` is told its address."""
    import gradio as gr
    from starlette.middleware import Middleware

    fonts = {"font": ["system-ui", "sans-serif"], "font_mono": ["monospace"]}  # those of the computer: no network
    blocks.launch(
        server_name=HOST,
        server_port=port,
        share=False,
        inbrowser=opened,
        prevent_thread_lock=True,
        quiet=True,
        allowed_paths=[],
        app_kwargs={"middleware": [Middleware(Guard, port=port, folder=folder)]},
        max_file_size=LARGEST_PHOTO,
        footer_links=[],
        enable_monitoring=False,
        mcp_server=False,
        pwa=False,
        ssr_mode=False,
        strict_cors=True,
        head=HEAD,
        theme=gr.themes.Default(**fonts),
    )
    try:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that the temporary folder goes
        ready(f"http://{HOST}:{port}")
        threading.Event().wait()
    except KeyboardInterrupt:
        pass
    finally:
        logging.getLogger("uvicorn.error").setLevel(logging.CRITICAL)  # that tabs are open is no error
        blocks.server.config.timeout_graceful_shutdown = 1  # second; else uvicorn waits until they are closed
        blocks.close(verbose=False)


def _answer(method: Callable[[dict], dict]) -> Callable[[Any], dict]:
    """A method of a room for the browser: what is wrong is told in a line, and nothing else of it."""

    @wraps(method)
    def answer(request: Any) -> dict:
        try:
            if not isinstance(request, dict):
                raise ValueError("a request is an object")
            return _sendable(method(request))
        except (ValueError, OSError) as error:
            return {"error": printable(" ".join(str(error).split()))}

    return answer


def _sendable(value: Any) -> Any:
    """An answer with all its texts `printable`: with others, nothing would arrive."""
    if isinstance(value, dict):
        return {_sendable(key): _sendable(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_sendable(item) for item in value]
    return printable(value) if isinstance(value, str) else value


def _capture_tab(gr: Any, room: "CaptureRoom", _: Any) -> None:
    methods = (room.look, room.start, room.resume, room.press, room.drop, room.strip)
    _own_page(gr, "capture_coach", "capture", methods)


def _masks_tab(gr: Any, room: "MaskRoom", _: Any) -> None:
    methods = (room.groups, room.progress, room.open, room.photo, room.start, room.draw, room.save)
    _own_page(gr, "mask_editor", "masks", methods)


def _own_page(gr: Any, name: str, elem_id: str, methods: Sequence[Callable[[dict], dict]]) -> None:
    """A room of our own HTML, CSS and JavaScript, whose `server` has these methods."""
    html, css, code = ((PAGE / f"{name}.{kind}").read_text(encoding="utf-8") for kind in ("html", "css", "js"))
    gr.HTML(
        "",
        html_template=html,
        css_template=(PAGE / "room.css").read_text(encoding="utf-8") + css,
        js_on_load=code,
        server_functions=[_answer(method) for method in methods],
        elem_id=elem_id,
    )


def _targets_tab(gr: Any, room: "TargetRoom", blocks: Any) -> None:
    def told(function: Callable) -> Callable:
        def run(*values):
            try:
                return function(*values)
            except (ValueError, OSError) as error:
                raise gr.Error(" ".join(str(error).split()), print_exception=False) from None

        return run

    with gr.Row():
        chosen = gr.Dropdown([*room.sets], value=next(iter(room.sets)), label="Made by", elem_id="set")
        group = gr.Dropdown([], label="Group", elem_id="target-group")
        photo = gr.Dropdown([], label="Photo", elem_id="target-photo")
    style = (
        "div:has(> figure) { display: grid; grid-template-columns: repeat(auto-fit, minmax(14rem, 1fr)); gap: .7rem }"
    )
    style += (
        " figure { margin: 0 } img { width: 100%; height: auto } h2 { font-size: 1.1rem; overflow-wrap: anywhere }"
    )
    text = "Inside the outlined target, training pulls the base's prediction to the surface target. Near is bright; "
    gr.Markdown(text + "where the two differ most, their difference is bright.")
    maps = gr.HTML("", css_template=style, elem_id="maps")

    @told
    def of_set(name):
        found = room.groups(name)
        return gr.Dropdown(choices=found, value=found[0] if found else None)

    @told
    def of_group(name, one):
        found = room.photos(name, one) if one else []
        return gr.Dropdown(choices=found, value=found[0] if found else None)

    show = told(lambda name, one, which: room.show(name, one, which) if one and which else "")
    blocks.load(of_set, [chosen], [group])
    chosen.input(of_set, [chosen], [group])
    group.change(of_group, [chosen, group], [photo]).then(show, [chosen, group, photo], [maps])
    photo.input(show, [chosen, group, photo], [maps])


def _compare_tab(gr: Any, room: "CompareRoom", _: Any) -> None:
    adapted = room.model.adapted

    def compare(photo, scale):
        if photo is None:
            return None, "Choose a photo."
        try:
            return room.compare(photo, float(scale))
        except (ValueError, OSError) as error:
            return None, f"**{' '.join(str(error).split())}**"

    def points(photo, scale, view):
        try:
            return None if photo is None else str(room.points(photo, float(scale), float(view)))
        except (ValueError, OSError):
            return None  # said already

    with gr.Row():
        with gr.Column():
            photo = gr.Image(
                type="filepath",
                label="Photo",
                elem_id="photo",
                height=340,
                sources=["upload", "clipboard"],
            )
            # The file as it is: `read_image` turns and converts it, or says why not.
            photo.preprocess = lambda given: None if given is None else given.path
            scale = gr.Slider(
                0, 1, 1, step=0.05, label="Adapter scale: 0 is the base", elem_id="scale", visible=adapted
            )
            view = gr.Slider(30, 110, 60, step=1, label="Field of view of the camera, degrees (for the points)")
        with gr.Column():
            said = gr.Markdown("Choose a photo. Near is bright.", elem_id="said")
            depths = gr.ImageSlider(label="Base left, adapted right", elem_id="depths")
            cloud = gr.Model3D(label="Points, from the adapted depth", elem_id="points", height=380)
    inputs = [photo, scale]
    photo.change(compare, inputs, [depths, said], concurrency_limit=1).then(points, [*inputs, view], [cloud])
    # While the slider moves, only its last place is computed.
    scale.change(compare, inputs, [depths, said], concurrency_limit=1, trigger_mode="always_last")
    for release in (scale.release, view.release):
        release(points, [*inputs, view], [cloud], concurrency_limit=1, trigger_mode="always_last")
