"""Installed as ``hudepth.pretrained``: its folder ``nyu`` is the model that ``checkpoint=nyu`` names."""
