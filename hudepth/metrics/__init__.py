"""Depth metrics, SSIM, and the protocols that decide what is scored."""
