"""H.264 files of the atlas: a frame a Z plane, as YCbCr of the full range with chroma at full resolution."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..io.guard import why
from ..scene.blocks import CELL_VOXELS
from .codecs import CodecSettings, import_av
from .image_files import check_present

YCBCR_FROM_RGB = np.array(  # BT.601, full range
    [[0.299, 0.587, 0.114], [-0.168735892, -0.331264108, 0.5], [0.5, -0.418687589, -0.081312411]], np.float32
)
YCBCR_OFFSET = np.array([0, 128, 128], np.float32)
KEY_FRAME_INTERVAL = CELL_VOXELS  # frames: a group of frames that depend on one another is a layer of cells


class VideoWriter:
    """Writes frames uint8 [H, W, 3], one after another, to an H.264 file."""

    def __init__(self, path: Path, codec: CodecSettings) -> None:
        """Raises SnergError when PyAV is missing."""
        self.av, self.path, self.codec = import_av(), path, codec
        self.buffer = io.BytesIO()  # the compressed video is small; a full disk then fails in `close`, as with any other file
        self.container = self.av.open(self.buffer, "w", format="mp4")
        self.stream: Any = None

    def add(self, pixels: NDArray[Any]) -> None:
        """Append a frame, uint8 [H, W, 3]; all have the size of the first."""
        if self.stream is None:
            # Without x264's macroblock tree, whose result changes from run to run for frames of few blocks: one scene, one file.
            options = {
                "crf": f"{0.51 * (100 - self.codec.quality):.2f}",
                "preset": "medium",
                "sc_threshold": "0",
                "x264-params": "mbtree=0",
            }
            self.stream = self.container.add_stream("libx264", rate=KEY_FRAME_INTERVAL, options=options)
            self.stream.height, self.stream.width = pixels.shape[:2]
            self.stream.pix_fmt, self.stream.gop_size = "yuv444p", KEY_FRAME_INTERVAL
        planes = _round_to_bytes(pixels.astype(np.float32) @ YCBCR_FROM_RGB.T + YCBCR_OFFSET).transpose(2, 0, 1)
        frame = self.av.VideoFrame.from_ndarray(np.ascontiguousarray(planes), format="yuv444p")
        self.container.mux(self.stream.encode(frame))

    def close(self) -> None:
        """Write the file. Raises OSError when it cannot be written."""
        if self.stream is not None:
            self.container.mux(self.stream.encode())
        self.container.close()
        self.path.write_bytes(self.buffer.getbuffer())


def read_video(path: Path, shape: tuple[int, int, int]) -> Iterator[NDArray[Any]]:
    """The frames that `VideoWriter` wrote, uint8 of exactly that shape [H, W, 3], one after another.

    Raises SnergError naming the file when it is missing, damaged, of another shape or too short, or when PyAV is missing.
    """
    av = import_av()
    check_present(path)
    try:
        with av.open(os.fspath(path), format="mp4") as container:
            stream = container.streams.video[0]
            if (stream.height, stream.width) != shape[:2] or stream.pix_fmt != "yuv444p":
                raise SnergError(f"{path} is a video of another kind; the scene's folder is damaged: export it again.")
            for frame in container.decode(stream):
                planes = frame.to_ndarray(format="yuv444p").transpose(1, 2, 0)
                yield _round_to_bytes((planes.astype(np.float32) - YCBCR_OFFSET) @ np.linalg.inv(YCBCR_FROM_RGB).T)
    except (av.FFmpegError, IndexError, ValueError, OSError, RuntimeError, MemoryError, TypeError) as error:
        raise SnergError(f"The video {path} is damaged ({why(error)}); export the scene again.") from error
    raise SnergError(f"The video {path} is cut short; export the scene again.")


def _round_to_bytes(values: NDArray[Any]) -> NDArray[Any]:
    """To uint8 without a bias, which would add up along a ray: Pillow's own conversion is a level and a half too dark."""
    rounded: NDArray[Any] = np.clip(np.rint(values), 0, 255).astype(np.uint8)
    return rounded
