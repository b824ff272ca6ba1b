"""Read a plain folder of colour and depth images; this format is tried last.

color|colour|rgb|image|images/   depth|depths/     paired by name, else by the number in it, else by order
calibration.json                                   fx fy cx cy [width height depth_scale …], or --fx on the command line
groundtruth.txt                                    optional: "t tx ty tz qx qy qz qw", t as for the images

Names such as 12.033333.png are times in seconds; otherwise frames are 1/30 s apart. Depth is in mm by default.
"""

from pathlib import Path

from sigmasplat.api import (
    COLOR_ENDINGS,
    COLOR_FOLDERS,
    DEPTH_ENDINGS,
    DEPTH_FOLDERS,
    MM_PER_METRE,
    ImagePair,
    InputConfig,
    RecordedSource,
    SourceError,
    SourceFormat,
    first_subfolder,
    folder_source,
    index_by_number,
    list_images,
    pair_images,
    read_groundtruth,
    times_of_names,
    without_depth,
)

NAMES = "color|rgb|images/*", "depth/*"


def open_plain(path: str, settings: InputConfig) -> RecordedSource:
    """Open a folder. Raises SourceError if images cannot be paired or the camera is unknown."""
    folder = Path(path)
    depth_folder = first_subfolder(folder, DEPTH_FOLDERS)
    if depth_folder is None and (problem := without_depth(folder)):
        raise problem
    colors = list_images(first_subfolder(folder, COLOR_FOLDERS), COLOR_ENDINGS)
    pairs, skipped = _pairs(folder, colors, list_images(depth_folder, DEPTH_ENDINGS))
    times_s = times_of_names([color for color, _ in pairs])
    images = [ImagePair(t, *pair) for t, pair in zip(times_s, pairs, strict=True)]
    return folder_source(folder, settings, images, None, MM_PER_METRE, read_groundtruth(folder), skipped)


def _pairs(folder: Path, colors: list[Path], depths: list[Path]) -> tuple[list[tuple[Path, Path]], list[str]]:
    """Pair images by name, else by number, else by order if both kinds have the same count."""
    stems, depth_stems = {path.stem: path for path in colors}, {path.stem: path for path in depths}
    if stems.keys() & depth_stems.keys():
        names, skipped = pair_images(folder, stems, depth_stems, *NAMES)
        return [(stems[name], depth_stems[name]) for name in names], skipped
    color_by_number, depth_by_number = index_by_number(colors), index_by_number(depths)
    if colors and len(colors) == len(depths) and not color_by_number.keys() & depth_by_number.keys():
        return list(zip(colors, depths, strict=True)), []
    if colors and depths and (len(color_by_number), len(depth_by_number)) != (len(colors), len(depths)):
        raise SourceError(
            f"{folder}: {len(colors)} colour and {len(depths)} depth images share no names, and their numbers are not "
            "unique; give each pair the same name"
        )
    keys, skipped = pair_images(folder, color_by_number, depth_by_number, *NAMES)
    return [(color_by_number[n], depth_by_number[n]) for n in keys], skipped


PLUGIN = SourceFormat(
    "plain folder",
    "color/ (or rgb/, images/) and depth/",
    lambda path: first_subfolder(Path(path), (*COLOR_FOLDERS, *DEPTH_FOLDERS)) is not None,
    open_plain,
    priority=-1,
)
