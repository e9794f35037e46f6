"""The size of a JPEG XL image, read from its header without decoding the image."""

from __future__ import annotations

SIGNATURE = b"\xff\x0a"  # of a bare codestream
MAX_HEADER_BYTES = 16  # the signature and the longest size header (77 bits)
SIDE_BITS = (9, 13, 18, 30)  # of a side that is no multiple of 8, by its 2-bit selector
RATIOS = ((1, 1), (12, 10), (4, 3), (3, 2), (16, 9), (5, 4), (2, 1))  # width to height, by selector 1 to 7


def jxl_size(header: bytes) -> tuple[int, int]:
    """Width and height, pixels, of a bare codestream (ISO/IEC 18181-1, annex D). header: its first MAX_HEADER_BYTES bytes.

    Raises ValueError for other bytes, also for a codestream in a container: `encode_image` writes none.
    """
    if header[:2] != SIGNATURE:
        raise ValueError("it is not a bare JPEG XL codestream")
    bits = int.from_bytes(header[2:MAX_HEADER_BYTES].ljust(MAX_HEADER_BYTES - 2, b"\0"), "little")

    def take(count: int) -> int:
        nonlocal bits
        value = bits & ((1 << count) - 1)
        bits >>= count
        return value

    def side(small: int) -> int:
        return 8 * (take(5) + 1) if small else take(SIDE_BITS[take(2)]) + 1

    small = take(1)
    height = side(small)
    ratio = take(3)
    if ratio:
        across, down = RATIOS[ratio - 1]
        return height * across // down, height
    return side(small), height
