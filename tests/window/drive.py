"""Runs inside a full Blender: `blender --enable-event-simulate --python drive.py -- WALK FOLDER ARGUMENT...`.

A walk (walks.py) is a generator: it sends events to Blender's window, and each of its `yield`s lets Blender take them and
draw. What it saw is written to FOLDER/WALK.json, with the pictures of the window beside it; then Blender quits.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bpy

TICK_SECONDS = 0.03
FEWEST_TICKS = 3  # of a wait: Blender takes an event, runs its timers and draws
BUSY = 10  # times as long as an idle one a busy machine may take
SIDEBAR_MARGIN = 90  # pixels from the sidebar's left edge, where every row of a panel has its button
TAB_MARGIN = 8  # pixels from its right edge, where the tabs are
ROW = 18  # pixels, less than a button's height
Walk = Iterator[None]


class Window:
    """Blender's first window, by its events; and what the add-on's panels say."""

    def __init__(self, name: str, folder: Path) -> None:
        self.folder = folder
        self.seen: dict[str, Any] = {"error": ""}
        self.longest_pause = 0.0  # seconds between two ticks: how long the window did not answer
        self.pointer = (10, 10)
        self._report = folder / f"{name}.json"
        self._last_tick = time.monotonic()

    @property
    def window(self) -> Any:
        """Fetched each time: opening a file makes new ones."""
        return bpy.context.window_manager.windows[0]

    @property
    def settings(self) -> Any:
        """The add-on's settings of the scene that the window shows."""
        return self.window.scene.snerg

    @property
    def view(self) -> Any:
        """The area of the 3D view."""
        return next(area for area in self.window.screen.areas if area.type == "VIEW_3D")

    @property
    def sidebar(self) -> Any:
        """The 3D view's region that N opens; 1 pixel wide when closed."""
        return next(region for region in self.view.regions if region.type == "UI")

    def send(self, kind: str, value: str, **more: Any) -> None:
        """One event at the pointer."""
        self.window.event_simulate(type=kind, value=value, x=self.pointer[0], y=self.pointer[1], **more)

    def move(self, x: float, y: float) -> Walk:
        """Move the pointer, in pixels of the window from its lower left corner."""
        self.pointer = (int(x), int(y))
        self.send("MOUSEMOVE", "NOTHING")
        yield

    def over_view(self) -> Walk:
        """The pointer over the 3D view, away from the sidebar and the scene's objects."""
        view = self.view
        yield from self.move(view.x + view.width // 3, view.y + view.height // 4)

    def press(self, kind: str, **modifiers: bool) -> Walk:
        """A key or mouse button, pressed and released."""
        self.send(kind, "PRESS", **modifiers)
        self.send(kind, "RELEASE", **modifiers)
        yield

    def type(self, text: str) -> Walk:
        """Letters, spaces and a 2, as a keyboard gives them."""
        for letter in text:
            kind = {" ": "SPACE", "2": "TWO"}.get(letter, letter.upper())
            self.send(kind, "PRESS", unicode=letter)
            self.send(kind, "RELEASE")
            yield

    def wait(self, seconds: float) -> Walk:
        """Let time pass, and Blender answer some times, however busy the machine is."""
        until = time.monotonic() + seconds
        ticks = 0
        while time.monotonic() < until or ticks < FEWEST_TICKS:
            ticks += 1
            yield

    def until(self, condition: Callable[[], Any], seconds: float) -> Iterator[None]:
        """Until the condition holds; `yield from` gives whether it came to that. seconds: what an idle machine takes at most."""
        limit = time.monotonic() + BUSY * seconds
        while not condition():
            if time.monotonic() > limit:
                return False
            yield
        return True

    def open_sidebar(self) -> Walk:
        """N, then a click on the tab. Raises AssertionError when there is no such tab."""
        yield from self.over_view()
        if self.sidebar.width <= 1:
            yield from self.press("N")
            yield from self.until(lambda: self.sidebar.width > 1, 5)
        sidebar = self.sidebar
        x, top = sidebar.x + sidebar.width - TAB_MARGIN, sidebar.y + sidebar.height
        for y in range(top - ROW, sidebar.y, -2 * ROW):
            if sidebar.active_panel_category == "SNeRG":
                break
            yield from self.move(x, y)
            yield from self.press("LEFTMOUSE")
        assert sidebar.active_panel_category == "SNeRG", "The sidebar has no tab SNeRG"
        yield from self.wait(0.3)

    def find(self, operator: str, from_right: int = 0) -> Walk:
        """The pointer over a button of the sidebar. Raises AssertionError when it is not there.

        from_right: pixels from the sidebar's right edge to a button that does not begin at the left.

        Blender tells no script where it drew a button; Ctrl-C over one copies the call that it makes.
        """
        yield from self.open_steps()
        yield from self.seek(f"bpy.ops.{operator}(", f"button for {operator}", from_right, ctrl=True)

    def find_setting(self, path: str) -> Walk:
        """The pointer over a setting in the steps that are open. path: what Shift-Ctrl-C copies there, such as 'snerg.cameras'."""
        yield from self.seek(path, f"setting {path}", ctrl=True, shift=True, from_right=SIDEBAR_MARGIN)

    def seek(self, copied: str, what: str, from_right: int = 0, **keys: bool) -> Walk:
        """The pointer over what copies a text that begins with `copied` when C is pressed with `keys`."""
        sidebar = self.sidebar
        x, top = sidebar.x + (sidebar.width - from_right if from_right else SIDEBAR_MARGIN), sidebar.y + sidebar.height
        yield from self.move(x, top - ROW)
        yield from self.scroll("WHEELUPMOUSE", 40)
        for _page in range(5):
            for y in range(top - ROW, sidebar.y + ROW, -ROW):
                bpy.context.window_manager.clipboard = ""
                yield from self.move(x, y)
                yield from self.press("C", **keys)
                if bpy.context.window_manager.clipboard.startswith(copied):
                    return
            yield from self.scroll("WHEELDOWNMOUSE", 8)
        raise AssertionError(f"The sidebar has no {what}")

    def scroll(self, wheel: str, times: int) -> Walk:
        """Turn the mouse's wheel."""
        for _ in range(times):
            self.send(wheel, "PRESS")
        yield from self.wait(0.3)

    def click(self, operator: str, from_right: int = 0) -> Walk:
        """Click a button of the sidebar."""
        yield from self.find(operator, from_right)
        yield from self.press("LEFTMOUSE")

    def picture(self, name: str) -> Walk:
        """Keep what the window shows as FOLDER/NAME.png, without the button under the pointer lit up."""
        yield from self.over_view()
        yield from self.wait(0.4)
        self.shoot(name)

    def shoot(self, name: str) -> None:
        """The same at once. Where Blender draws by software its own screenshots are black: ImageMagick takes the screen's."""
        path = str(self.folder / f"{name}.png")
        if os.environ.get("DISPLAY") and shutil.which("import"):
            subprocess.run(["import", "-window", "root", path], check=True)
        else:
            with bpy.context.temp_override(window=self.window):
                bpy.ops.screen.screenshot(filepath=path)

    def texts(self, panel: str) -> list[str]:
        """What a panel ('main', 'field', ...) says, as it would be drawn now: labels, and the texts of buttons and bars."""
        layout = Layout()
        module = import_module("bl_ext.user_default.snerg_addon.snerg_addon.panels.main")
        with bpy.context.temp_override(window=self.window):
            if panel in ("main", "farm"):
                getattr(bpy.types, f"SNERG_PT_{panel}").draw(SimpleNamespace(layout=layout), bpy.context)
            else:
                next(step for step in module.STEPS if step.key == panel).draw_body(layout, bpy.context)
        return layout.texts

    def open_steps(self) -> Walk:
        """All steps of the panel, as clicks on their headers open them."""
        state = bpy.context.window_manager.snerg_steps
        for name in ("box", "dataset", "field", "bake", "preview", "study", "export"):
            setattr(state, name, True)
        self.sidebar.tag_redraw()
        yield from self.wait(0.3)

    def busy(self) -> bool:
        """The panel shows a bar of progress."""
        return any(text.startswith("progress:") for text in self.texts("main"))

    def file(self, what: str, path: Path | None = None) -> Walk:
        """'save_as_mainfile', 'open_mainfile' or 'read_homefile': what the File menu does."""
        with bpy.context.temp_override(window=self.window):
            getattr(bpy.ops.wm, what)(**({"filepath": str(path)} if path else {}))
        yield from self.wait(0.5)

    def operator(self, name: str, **keywords: Any) -> set[str]:
        """Call an operator of the add-on as a script does: it blocks until it is done."""
        with bpy.context.temp_override(window=self.window):
            return set(getattr(bpy.ops.snerg, name)(**keywords))

    def tick(self) -> None:
        """Take note of how long the window did not answer."""
        now = time.monotonic()
        self.longest_pause = max(self.longest_pause, now - self._last_tick)
        self._last_tick = now

    def write(self) -> None:
        """What was seen so far."""
        self._report.write_text(json.dumps(self.seen, indent=1, default=str))


class Layout:
    """Stands in for Blender's layout, which tells no script what was put into it; keeps the texts, draws nothing."""

    def __init__(self, texts: list[str] | None = None) -> None:
        self.texts: list[str] = [] if texts is None else texts

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)

        def put(*values: Any, **keywords: Any) -> Any:
            text = keywords.get("text") or ""
            if name == "progress":
                text = f"progress: {text}"
            elif name == "operator" and not text:
                text = str(values[0])
            if text:
                self.texts.append(text)
            if name in ("panel", "panel_prop"):
                return Layout(self.texts), Layout(self.texts)
            return SimpleNamespace() if name == "operator" else Layout(self.texts)

        return put


def main(walks: Any = None) -> None:
    """Do the walk that the command line names: a function of a module, walks.py by default."""
    name, folder, *arguments = sys.argv[sys.argv.index("--") + 1 :]
    sys.path.insert(0, str(Path(__file__).parent))
    walks = walks or import_module("walks")
    view = bpy.context.preferences.view
    view.show_splash, view.filebrowser_display_type = False, "SCREEN"
    bpy.context.preferences.use_preferences_save = False
    bpy.context.preferences.system.use_region_overlap = False  # else the 3D view is drawn again with each button that the pointer passes
    window = Window(name, Path(folder))
    steps = getattr(walks, name)(window, *arguments)

    def tick() -> float | None:
        window.tick()
        try:
            next(steps)
            return TICK_SECONDS
        except StopIteration:
            pass
        except Exception as error:  # of the walk: the test shows it
            window.seen["error"] = f"{type(error).__name__}: {error}\n{traceback.format_exc()}"
            window.shoot("error")
        window.write()
        bpy.ops.wm.quit_blender()
        return None

    bpy.app.timers.register(tick, first_interval=1.0, persistent=True)


if __name__ == "__main__":
    main()
