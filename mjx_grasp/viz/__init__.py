"""Pictures: video, plots, HTML report."""
