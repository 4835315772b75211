"""Helpers for all packages: folders and caches on disk, progress, and the files shipped with mcsim."""
