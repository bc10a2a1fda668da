"""Installed as ``hydra_plugins.hudepth``, where Hydra takes sweepers from; the work is in ``hudepth.tasks.sweep``."""

from __future__ import annotations

import hudepth.tasks.sweep


class Sweep(hudepth.tasks.sweep.Sweep):
    """What ``_target_`` in conf/hydra/sweeper/hudepth.yaml names."""
