"""What every package leans on: folders and caches on disk, progress, and the files that the package ships."""
