"""core stands without Blender, and without JAX wherever a module does not say that it needs it."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
JAX_MODULES = {
    f"snerg.core.{name}"
    for name in (
        "baking.fine_tune",
        "baking.fit_voxels",
        "study.training_cost",
        "training.device_sampler",
        "training.dispatch",
        "training.hierarchical_sampler",
        "training.non_finite",
        "training.occupancy_sampler",
        "training.optimizer",
        "training.parallel",
        "training.prepare",
        "training.saving",
        "training.state",
        "training.trainer",
        "training.view_dependence_test",
        "training.weight_average",
    )
}

BLOCK_AND_IMPORT = """
import sys
blocked = sys.argv[1].split(",")
class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in blocked:
            raise ImportError(f"{name} is blocked in this test")
sys.meta_path.insert(0, Blocker())
import importlib
for name in sys.argv[2:]:
    importlib.import_module(name)
"""


def core_modules() -> list[str]:
    """Every module of core, as snerg.core.x.y."""
    names = []
    for path in sorted((ROOT / "core").rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        names.append(".".join(("snerg", *(p for p in parts if p != "__init__"))))
    return names


def import_with(blocked: str, modules: list[str]) -> None:
    result = subprocess.run([sys.executable, "-c", BLOCK_AND_IMPORT, blocked, *modules], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


def test_core_imports_without_blender():
    pytest.importorskip("jax")
    import_with("bpy,mathutils,bpy_extras", core_modules())


def test_core_imports_without_jax():
    import_with("bpy,mathutils,bpy_extras,jax,jaxlib", [name for name in core_modules() if name not in JAX_MODULES])


def test_the_modules_that_want_jax_still_do():
    """A module that no longer needs JAX must leave the list."""
    for name in JAX_MODULES & set(core_modules()):
        with pytest.raises(AssertionError, match="jax"):
            import_with("jax,jaxlib", [name])
