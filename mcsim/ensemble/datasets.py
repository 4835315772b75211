"""Datasets in memory, written to disk as Zarr at once: on a disk zarr hands every small file to a thread."""

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from zarr.core.buffer import Buffer
from zarr.storage import MemoryStore

from mcsim.support.folders import appearing, real_path, remove

if TYPE_CHECKING:
    import xarray as xr

Files = dict[str, Buffer]  #: contents of the files of a store, by their paths in it


def write_dataset(dataset: "xr.Dataset", folder: Path, **form: Any) -> None:
    """Write a dataset that is in memory to a folder, in place of what is there, as :meth:`xarray.Dataset.to_zarr`.

    What is there stays if the new one cannot be written.
    """
    files: Files = {}
    with warnings.catch_warnings():
        # Zarr warns that consolidated metadata, which xarray looks for, are not yet standard.
        warnings.simplefilter("ignore", category=UserWarning)
        dataset.to_zarr(MemoryStore(files), **({"consolidated": True} | form))
    with appearing(folder) as scratch:
        write_files(files, scratch)
        remove(real_path(folder))


def write_files(files: Files, folder: Path) -> None:
    """Write what zarr made in memory."""
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content.to_bytes())
