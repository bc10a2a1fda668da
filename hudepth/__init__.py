"""hudepth: monocular depth estimation with a hybrid UNet and the BADCL loss.

``import hudepth`` takes milliseconds; torch is loaded on first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hudepth.inference.depth_map import DepthMap
    from hudepth.inference.model import DepthModel

__version__ = "0.1.0"
__all__ = ["DepthMap", "DepthModel", "load"]


def load(spec: Any, **options: Any) -> DepthModel:
    """Load a model to predict with; see :func:`hudepth.inference.model.load` for the options.

    Args:
        spec: a checkpoint, run directory, bundle, exported file, or ``last`` for the newest run.
        **options: ``backend``, ``device``, ``precision``, ``threads``, ``size``, ``fit``, ``flip``, ``camera``,
            ``trust``, ``runs``.

    Raises:
        HudepthError: with one line that states the fix.
    """
    from hudepth.inference.model import load as load_model

    return load_model(spec, **options)


def __getattr__(name: str) -> Any:
    modules = {"DepthMap": "hudepth.inference.depth_map", "DepthModel": "hudepth.inference.model"}
    if name in modules:
        return getattr(import_module(modules[name]), name)
    raise AttributeError(f"module 'hudepth' has no attribute '{name}'")
