"""What several tests share: made files, stand-in stages, reference optics."""
