# The one list of what plug-ins import, and the homes of the names (api.py reads it). A name keeps its meaning when its
# home moves. Plug-ins of others need few: the rows of registry.py, Camera, Frame, Config, Source, Trajectory.
from sigmasplat import env as env
from sigmasplat.config import (
    Config as Config,
    FinalConfig as FinalConfig,
    InputConfig as InputConfig,
    RenderConfig as RenderConfig,
    TrackingConfig as TrackingConfig,
)
from sigmasplat.config.find_preset import (
    default_preset as default_preset,
    is_preset as is_preset,
    list_presets as list_presets,
    preset as preset,
    presets_by_scene as presets_by_scene,
)
from sigmasplat.config.input import SensorModel as SensorModel
from sigmasplat.config.text import differences as differences, override as override
from sigmasplat.data import harmonics as harmonics, se3 as se3
from sigmasplat.data.atlas import Atlas as Atlas
from sigmasplat.data.camera import Camera as Camera, exposed as exposed, unexposed as unexposed
from sigmasplat.data.camera_errors import sensor_said as sensor_said
from sigmasplat.data.field import (
    ATTRIBUTES as ATTRIBUTES,
    COLUMNS as COLUMNS,
    GaussianField as GaussianField,
    Rows as Rows,
)
from sigmasplat.data.frame import Frame as Frame, photo_size as photo_size
from sigmasplat.data.frame_arrays import (
    UINT16_MAX as UINT16_MAX,
    color_from_bytes as color_from_bytes,
    frame_from_arrays as frame_from_arrays,
)
from sigmasplat.data.images import resized_color as resized_color
from sigmasplat.data.mesh import Mesh as Mesh, mesh_depth as mesh_depth
from sigmasplat.data.readout import Readout as Readout, SensorTimes as SensorTimes, read_at_once as read_at_once
from sigmasplat.data.submap import Picture as Picture, SubmapStore as SubmapStore
from sigmasplat.data.trajectory import (
    APART as APART,
    LOST as LOST,
    RELOCALISED as RELOCALISED,
    TRACKED as TRACKED,
    Trajectory as Trajectory,
    evenly_spaced as evenly_spaced,
    evenly_spread as evenly_spread,
    outside_world as outside_world,
    states_at_end as states_at_end,
    submaps_outside as submaps_outside,
)
from sigmasplat.env import (
    import_optional as import_optional,
    install_extra as install_extra,
    install_package as install_package,
    opencv as opencv,
)
from sigmasplat.errors import (
    BackendError as BackendError,
    ConfigError as ConfigError,
    DownloadError as DownloadError,
    RunError as RunError,
    SigmaSplatError as SigmaSplatError,
    SourceError as SourceError,
    is_out_of_memory as is_out_of_memory,
    nearest as nearest,
    out_of_memory as out_of_memory,
)
from sigmasplat.files import machine as machine
from sigmasplat.files.atomic import make_folder as make_folder, replacing as replacing, write_text as write_text
from sigmasplat.files.json_files import read_json as read_json, write_json as write_json
from sigmasplat.files.lock import locked as locked
from sigmasplat.files.machine import INSTALLED as INSTALLED, code_digest as code_digest, usable_cores as usable_cores
from sigmasplat.files.pictures import check_pixels as check_pixels
from sigmasplat.files.ply_elements import (
    PLY_TYPES as PLY_TYPES,
    Element as Element,
    header_of as header_of,
    read_header as read_header,
)
from sigmasplat.files.reading import (
    DAMAGED as DAMAGED,
    MOST_JSON_BYTES as MOST_JSON_BYTES,
    csv_rows as csv_rows,
    exists as exists,
    guarded as guarded,
    open_binary as open_binary,
    open_regular as open_regular,
    parse_json as parse_json,
    read_bytes as read_bytes,
    read_text as read_text,
    refuse_special as refuse_special,
)
from sigmasplat.final.fusion import (
    AGREE_SHARE as AGREE_SHARE,
    FusionView as FusionView,
    Renderer as Renderer,
    count_keyframes as count_keyframes,
    fuse as fuse,
    silhouettes as silhouettes,
    surface_of as surface_of,
    surface_views as surface_views,
    voxel_edge as voxel_edge,
)
from sigmasplat.fit.adam import BETA1 as BETA1, BETA2 as BETA2, EPSILON as EPSILON, Rates as Rates
from sigmasplat.fit.backends import TORCH as TORCH, fits_of as fits_of
from sigmasplat.fit.descent import (
    descend as descend,
    exposure_rate as exposure_rate,
    parametrisation as parametrisation,
)
from sigmasplat.fit.interface import (
    NORMAL_TERMS as NORMAL_TERMS,
    Accumulator as Accumulator,
    AlignedPose as AlignedPose,
    AlignRules as AlignRules,
    Descent as Descent,
    DeviceFits as DeviceFits,
    ImageKernels as ImageKernels,
    LevelPlanes as LevelPlanes,
    Plane as Plane,
    Twist as Twist,
    Weights as Weights,
)
from sigmasplat.fit.losses import (
    SHAPE_TERMS as SHAPE_TERMS,
    kernel_weights as kernel_weights,
    pixel_weights as pixel_weights,
)
from sigmasplat.fit.mapping_step import (
    TorchStep as TorchStep,
    ViewDependentStep as ViewDependentStep,
    render_for as render_for,
)
from sigmasplat.fit.target import Target as Target, luma as luma
from sigmasplat.fit.tracking_loss import reference_maps as reference_maps, tracking_params as tracking_params
from sigmasplat.graph.closer import NETVLAD as NETVLAD, lacks_netvlad as lacks_netvlad
from sigmasplat.graph.loops import Loop as Loop
from sigmasplat.graph.path_covariance import PathCovariance as PathCovariance
from sigmasplat.input.calibration import (
    ASSUMED as ASSUMED,
    DEFINED as DEFINED,
    MEASURED as MEASURED,
    MM_PER_METRE as MM_PER_METRE,
    TUM_UNITS_PER_METRE as TUM_UNITS_PER_METRE,
    Calibration as Calibration,
    CameraUnknown as CameraUnknown,
    Distortion as Distortion,
    Origin as Origin,
    build_camera as build_camera,
    freiburg_calibration as freiburg_calibration,
    json_number as json_number,
    median_calibration as median_calibration,
    positive_number as positive_number,
    published as published,
    read_json_object as read_json_object,
    resolve_calibration as resolve_calibration,
    unlikely_camera as unlikely_camera,
)
from sigmasplat.input.images import (
    ASSUMED_TIMES as ASSUMED_TIMES,
    COLOR_ENDINGS as COLOR_ENDINGS,
    COLOR_FOLDERS as COLOR_FOLDERS,
    DEPTH_ENDINGS as DEPTH_ENDINGS,
    DEPTH_FOLDERS as DEPTH_FOLDERS,
    FRAMES_PER_SECOND as FRAMES_PER_SECOND,
    NAMED as NAMED,
    VIDEO_ENDINGS as VIDEO_ENDINGS,
    FrameFiles as FrameFiles,
    Video as Video,
    dated_seconds as dated_seconds,
    depth_to_metres as depth_to_metres,
    depth_values as depth_values,
    first_file as first_file,
    first_subfolder as first_subfolder,
    frame_files as frame_files,
    has_frame_files as has_frame_files,
    image_folder as image_folder,
    image_size as image_size,
    index_by_number as index_by_number,
    list_images as list_images,
    named_as as named_as,
    natural_key as natural_key,
    pair_images as pair_images,
    read_color as read_color,
    read_depth as read_depth,
    read_values as read_values,
    seconds_of as seconds_of,
    times_of_names as times_of_names,
    without_nan as without_nan,
)
from sigmasplat.input.imu import (
    GRAVITY_M_S2 as GRAVITY_M_S2,
    Accelerometer as Accelerometer,
    Gyroscope as Gyroscope,
    accelerometer_from_samples as accelerometer_from_samples,
    gyroscope_from_samples as gyroscope_from_samples,
)
from sigmasplat.input.intrinsics import intrinsics_beside as intrinsics_beside, read_intrinsics as read_intrinsics
from sigmasplat.input.lists import (
    FLIP_YZ as FLIP_YZ,
    associate as associate,
    build_trajectory as build_trajectory,
    checked_pose as checked_pose,
    listed_file as listed_file,
    nearest_gaps_s as nearest_gaps_s,
    pair_times as pair_times,
    parse_numbers as parse_numbers,
    read_groundtruth as read_groundtruth,
    read_lines as read_lines,
    read_listed as read_listed,
    read_matrix as read_matrix,
    read_pose_files as read_pose_files,
    read_poses as read_poses,
    refuse_unpaired as refuse_unpaired,
    rigid_transform as rigid_transform,
    time_origins as time_origins,
    to_matrix as to_matrix,
)
from sigmasplat.input.opening import (
    format_name as format_name,
    open_source as open_source,
    sqlite_tables as sqlite_tables,
    without_depth as without_depth,
)
from sigmasplat.input.recorded import (
    KNOWN_UNITS_PER_METRE as KNOWN_UNITS_PER_METRE,
    PLAUSIBLE_MEDIAN_M as PLAUSIBLE_MEDIAN_M,
    ImagePair as ImagePair,
    RecordedSource as RecordedSource,
    Size as Size,
    depth_warning as depth_warning,
    first_readable as first_readable,
    first_size as first_size,
    folder_source as folder_source,
    numbered_pairs as numbered_pairs,
)
from sigmasplat.input.rectification import Rectification as Rectification, registers_depth as registers_depth
from sigmasplat.input.source import Source as Source, Subset as Subset, Wrapped as Wrapped, read_ahead as read_ahead
from sigmasplat.input.transforms import (
    Fields as Fields,
    read_frames as read_frames,
    read_pose as read_pose,
    read_transforms_camera as read_transforms_camera,
)
from sigmasplat.registry import (
    Backend as Backend,
    DepthFilter as DepthFilter,
    Mask as Mask,
    Output as Output,
    Preset as Preset,
    SourceFormat as SourceFormat,
)
from sigmasplat.render import FieldRenderer as FieldRenderer, Render as Render, reference as reference, render as render
from sigmasplat.render.backend import automatic as automatic, make_view as make_view
from sigmasplat.render.kernels import (
    blend_with as blend_with,
    pose_gradient as pose_gradient,
    project_with as project_with,
    view_params as view_params,
)
from sigmasplat.render.render import as_refined as as_refined
from sigmasplat.render.self_test import kernel_speed as kernel_speed, self_test as self_test
from sigmasplat.render.view import Layers as Layers, View as View
from sigmasplat.run.callbacks import Callback as Callback
from sigmasplat.run.figures import format_ranges as format_ranges, number as number, rate as rate
from sigmasplat.run.resume import (
    StartPoint as StartPoint,
    StateFile as StateFile,
    resume as resume,
)
from sigmasplat.run.scene import config_of_facts as config_of_facts, open_scene as open_scene
from sigmasplat.run.session import Session as Session, new_folder as new_folder
from sigmasplat.run.terminal import Screen as Screen
from sigmasplat.run_folder import splat_ply as splat_ply
from sigmasplat.run_folder.frames import RunFrames as RunFrames, noted_up as noted_up
from sigmasplat.run_folder.run_values import MOST_NUMBER as MOST_NUMBER, fits as fits, frame_seconds as frame_seconds
from sigmasplat.run_folder.runs import MESH as MESH, TRUTH as TRUTH, RunFolder as RunFolder
from sigmasplat.run_folder.splat_values import (
    SH_C0 as SH_C0,
    Doubles as Doubles,
    SplatValues as SplatValues,
    morton_order as morton_order,
    smallest_three as smallest_three,
    to_bytes as to_bytes,
)
from sigmasplat.run_folder.trajectory import (
    write_square as write_square,
    write_trajectory as write_trajectory,
)
from sigmasplat.slam.results import Step as Step
from sigmasplat.system.slam import Slam as Slam
from sigmasplat.types import Matrix as Matrix, Progress as Progress, no_progress as no_progress
from sigmasplat.uncertainty.map_uncertainty import MapUncertainty as MapUncertainty, SplatStd as SplatStd
from sigmasplat.uncertainty.predictive import (
    Predicted as Predicted,
    predict as predict,
    predicted as predicted,
    variance_parts as variance_parts,
)
