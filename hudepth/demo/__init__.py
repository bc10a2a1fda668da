"""A web page that shows the depth a model predicts."""
