"""The viewer's optional code: which pages have which of it.

Each is a script, viewer/dist/optional/NAME.js (of viewer/src/optional/NAME.ts), which viewer.js loads when it is wanted. A folder holds
the script beside viewer.js; a page of one file holds it inside.
"""

from __future__ import annotations

from .page_settings import PLAIN, PageSettings

FOLDER = "optional"
PATH = "path"  # plays the camera path
BENCHMARK = "benchmark"  # measures frames a second when the address ends in #benchmark


def optional_names(single_file: bool, page: PageSettings = PLAIN, path: bool = False) -> tuple[str, ...]:
    """The optional code that a page calls for. path: whether it has a camera path. A page of one file has no benchmark, which people never
    ask for by accident."""
    return (*(() if single_file else (BENCHMARK,)), *((PATH,) if path else ()), *page_parts(page))


def page_parts(page: PageSettings) -> tuple[str, ...]:
    """The optional code that the page loads by itself, which cameras.json names."""
    asked = {"annotations": bool(page.annotations), "measure": page.measures, "vr": page.vr}
    return tuple(name for name, is_asked in asked.items() if is_asked)
