"""The exported page, served to this computer's browser."""

from __future__ import annotations

import urllib.error
import urllib.request

import bpy
import pytest

from snerg.snerg_addon import page_server
from snerg.snerg_addon.project import project_of


def test_the_page_is_served_until_the_addon_ends(scene):
    with pytest.raises(RuntimeError, match="There is no web page; export one"):
        bpy.ops.snerg.open_page()
    web = project_of(scene).web
    web.mkdir(parents=True)
    (web / "index.html").write_text("<title>first</title>")
    address = page_server.address_of(web)
    assert page_server.address_of(web) == address and address.startswith("http://127.0.0.1:")
    (web / "index.html").write_text("<title>second</title>")
    with urllib.request.urlopen(address) as answer:
        assert b"second" in answer.read() and answer.headers["Cache-Control"] == "no-store"
    page_server.stop()
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(address, timeout=5)
