"""The Hydra configuration tree, installed as the package ``hudepth.conf``."""
