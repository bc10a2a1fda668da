"""Every form in which image/depth pairs come."""
