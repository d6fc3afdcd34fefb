"""torch.ops.lightfield_gs, as soon as both torch and the package are imported, in either order.

The operators' own modules are imported when the first of them is asked for, which takes 0.1 s. So a program that
imports the package without torch waits for neither, and one that loads an exported program needs no other import.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from importlib.machinery import ModuleSpec

_MODULES = ("rasterizer.direct", "rasterizer.image_operators", "rasterizer.splat_operators", "encoding.compiled")


def register_with_torch() -> None:
    """Make torch.ops.lightfield_gs, at once or when torch is imported."""
    if "torch" in sys.modules:
        _make_namespace(sys.modules["torch"])
    else:
        sys.meta_path.insert(0, _AfterTorch())


def _make_namespace(torch: ModuleType) -> None:
    plain: Any = type(torch.ops.aten)

    class Namespace(plain):
        """A namespace of operators that registers them when it is asked for one that it does not know."""

        __module__ = plain.__module__  # exported programs name operators by it

        def __getattr__(self, name: str) -> Any:
            try:
                return super().__getattr__(name)
            except AttributeError:
                for module in _MODULES:
                    importlib.import_module(f"lightfield_gs.{module}")
                return super().__getattr__(name)

    torch.ops.lightfield_gs = Namespace("lightfield_gs")


class _AfterTorch:
    """A finder of sys.meta_path: it finds torch as the others do, and makes the namespace after torch is imported."""

    def find_spec(self, name: str, path: Any = None, target: ModuleType | None = None) -> ModuleSpec | None:
        if name != "torch":
            return None
        specs = (finder.find_spec(name, path, target) for finder in sys.meta_path if finder is not self)
        spec = next((spec for spec in specs if spec is not None), None)
        if spec is None or spec.loader is None:
            return spec
        run = spec.loader.exec_module

        def run_and_register(module: ModuleType) -> None:
            run(module)
            sys.meta_path.remove(self)
            _make_namespace(module)

        spec.loader.exec_module = run_and_register  # type: ignore[method-assign]
        return spec
