"""Installed as ``hydra_plugins.hudepth``, where Hydra takes sweepers from; the work is in ``hudepth.sweep.sweeper``."""

from __future__ import annotations

import hudepth.sweep.sweeper


class Sweep(hudepth.sweep.sweeper.Sweep):
    """What ``_target_`` in conf/hydra/sweeper/hudepth.yaml names."""
