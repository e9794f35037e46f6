"""The atlas on disk: the slices of its cells as images or videos, and cells.npy where a scene is not quantised.

KIND_NNN.SUFFIX holds an image of slice NNN (see codecs.images_of_slice); for H.264, KIND.mp4 holds all Z planes, a frame each.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..io.guard import check_file, reading
from ..progress import Progress
from ..scene.blocks import CELL_VOXELS
from ..scene.scene import Scene
from .atlas import SLICE_PLANES, atlas_blocks, atlas_slices, cells_from_slices, slice_count
from .codecs import CodecSettings, image_shapes, image_suffix, images_of_slice, slice_of_images
from .image_files import encode_image, read_image_file
from .video_files import VideoWriter, read_video

MAX_PENDING = 4  # slices that wait to be encoded: bounds the memory in use beside the scene's own
# An atlas has at most 64 MiB plus 4000 times its files' bytes. The factor is above what any codec reaches: PNG compresses a constant
# image by about 1000.
MIN_ATLAS_LIMIT, MAX_COMPRESSION = 2**26, 4000
MAX_FLOAT_BYTES = 2**37  # of cells.npy


def write_atlas(scene: Scene, folder: Path, codec: CodecSettings, progress: Progress) -> None:
    """Write the slices of a quantised scene, encoding two at a time: encoders release Python's global lock.

    Raises SnergError when a colour is above its alpha and the codec is lossy.
    """
    blocks = atlas_blocks(len(scene.cells))
    total = slice_count(blocks)
    videos = _open_videos(folder, codec, scene.cells.shape[-1])
    with ThreadPoolExecutor(2) as pool:
        pending: deque[Future[None]] = deque()
        for index, pixels in enumerate(atlas_slices(scene.cells, blocks)):
            if len(pending) == MAX_PENDING:
                pending.popleft().result()
            if videos:
                _add_frames(videos, pixels, codec)
            images = {"alpha": pixels[..., -1]} if videos else images_of_slice(pixels, codec)
            pending.append(pool.submit(_write_images, folder, index, images, codec))
            progress(index / total, "Writing the atlas")
        for job in pending:
            job.result()
    for video in videos.values():
        video.close()
    progress(1.0, "Writing the atlas")


def _write_images(folder: Path, index: int, images: dict[str, NDArray[Any]], codec: CodecSettings) -> None:
    for kind, pixels in images.items():
        (folder / f"{kind}_{index:03d}.{image_suffix(kind, codec)}").write_bytes(encode_image(kind, pixels, codec))


def _open_videos(folder: Path, codec: CodecSettings, channels: int) -> dict[str, VideoWriter]:
    """A writer for each kind that is stored as video; empty for other codecs than H.264."""
    if codec.name != "h264":
        return {}
    return {kind: VideoWriter(folder / f"{kind}.mp4", codec) for kind in ("rgb", "feature")[: channels // 4]}


def _add_frames(videos: dict[str, VideoWriter], pixels: NDArray[Any], codec: CodecSettings) -> None:
    """Append the Z planes of a slice to the videos."""
    for plane in np.split(pixels, SLICE_PLANES):
        images = images_of_slice(plane, codec)
        for kind, video in videos.items():
            video.add(images[kind])


def atlas_file_names(codec: CodecSettings, blocks: tuple[int, int, int], channels: int) -> list[str]:
    """The names of the files that `write_atlas` writes for an atlas of `blocks` cells with that many channels."""
    names: list[str] = []
    for kind in image_shapes((2 * SLICE_PLANES, 2, channels), codec):
        if codec.name == "h264" and kind != "alpha":
            names.append(f"{kind}.mp4")
        else:
            names += [f"{kind}_{index:03d}.{image_suffix(kind, codec)}" for index in range(slice_count(blocks))]
    return names


def read_atlas(folder: Path, codec: CodecSettings, blocks: tuple[int, int, int], count: int, channels: int) -> NDArray[Any]:
    """The first `count` cells of an atlas of `blocks` cells along x, y and z: uint8 [count, 32, 32, 32, channels].

    Raises SnergError naming the file when one is missing or damaged, or when the atlas is too large for the folder's files or for
    `count` cells.
    """
    if count > np.prod(blocks):
        size = " x ".join(map(str, blocks))
        raise SnergError(f"{folder} says that it has {count} cells in an atlas of {size}; export it again.")
    check_atlas_bytes(folder, int(np.prod(blocks)) * CELL_VOXELS**3 * channels)
    return cells_from_slices(slice_reader(folder, codec, blocks, channels), blocks, count, channels)


def check_atlas_bytes(folder: Path, size: int) -> None:
    """Raise SnergError when a folder's files cannot hold an atlas of `size` bytes, before memory is allocated for it."""
    stored = sum(path.stat().st_size for path in folder.iterdir() if path.is_file())
    if size > MIN_ATLAS_LIMIT + MAX_COMPRESSION * stored:
        raise SnergError(f"{folder} says that its atlas has {size >> 20} MiB, more than its files of {stored} bytes hold; export it again.")


def slice_reader(folder: Path, codec: CodecSettings, blocks: tuple[int, int, int], channels: int) -> Callable[[int], NDArray[Any]]:
    """A function from 0, 1, 2, ..., in this order, to that slice of the atlas: uint8 [4 * height, width, channels].

    The function raises SnergError as `read_atlas` does. Raises SnergError when the codec is not installed.
    """
    codec.check()
    height, width = SLICE_PLANES * blocks[1] * CELL_VOXELS, blocks[0] * CELL_VOXELS
    shapes = image_shapes((height, width, channels), codec)
    if codec.name != "h264":
        return lambda index: slice_of_images(
            {kind: read_image_file(folder / f"{kind}_{index:03d}.{image_suffix(kind, codec)}", shape) for kind, shape in shapes.items()},
            codec,
        )
    alpha_shape = shapes.pop("alpha")
    videos: dict[str, Iterator[NDArray[Any]]] = {
        kind: read_video(folder / f"{kind}.mp4", (shape[0] // SLICE_PLANES, width, 3)) for kind, shape in shapes.items()
    }

    def read(index: int) -> NDArray[Any]:
        planes = np.split(read_image_file(folder / f"alpha_{index:03d}.png", alpha_shape), SLICE_PLANES)
        return np.concatenate(
            [slice_of_images({"alpha": plane} | {kind: next(video) for kind, video in videos.items()}, codec) for plane in planes]
        )

    return read


def read_float_cells(path: Path, shape: tuple[int, ...]) -> NDArray[Any]:
    """cells.npy: float32 of exactly that shape, in [0, 1]. The header is checked before memory is allocated for the values.

    Raises SnergError naming the file when it is missing, damaged, of another shape or holds values outside [0, 1].
    """
    if not path.exists():
        raise SnergError(f"{path} is missing; the scene's folder is damaged: export it again.")
    check_file(path, MAX_FLOAT_BYTES)
    with reading(path, "export the scene again"):
        mapped: NDArray[Any] = np.lib.format.open_memmap(path, mode="r")  # type: ignore[no-untyped-call]
        if mapped.shape != shape or mapped.dtype != np.float32:
            raise ValueError(f"it is {mapped.shape} {mapped.dtype}, not {shape} float32")
        cells = np.array(mapped)
    check_float_cells(cells, str(path), "export the scene again")
    return cells


def check_float_cells(cells: NDArray[Any], where: str, advice: str) -> None:
    """Raise SnergError, which begins with `where`, when float cells hold NaN or a value outside [0, 1]: a march of them gives nonsense."""
    if not (cells.min(initial=0) >= 0 and cells.max(initial=0) <= 1):  # this form refuses NaN too
        raise SnergError(f"{where} holds values outside 0 to 1, or that are no numbers; {advice}.")
