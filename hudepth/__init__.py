"""hudepth: monocular depth estimation with a hybrid UNet and the BADCL loss.

``import hudepth`` takes milliseconds; torch is loaded on first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hudepth.inference.depth_map import DepthMap
    from hudepth.inference.model import DepthModel, load

__version__ = "0.1.0"
__all__ = ["DepthMap", "DepthModel", "load"]


if not TYPE_CHECKING:  # or a type checker would take any name for one that exists

    def __getattr__(name: str) -> Any:
        modules = {
            "DepthMap": "hudepth.inference.depth_map", "DepthModel": "hudepth.inference.model",
            "load": "hudepth.inference.model",
        }  # fmt: skip
        if name in modules:
            return getattr(import_module(modules[name]), name)
        raise AttributeError(f"module 'hudepth' has no attribute '{name}'")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
