"""hudepth: monocular depth estimation with a hybrid UNet and the BADCL loss.

The package imports nothing heavy: ``import hudepth`` takes milliseconds, torch is loaded by the module that needs it.
"""

__version__ = "0.1.0"
