from typing import Any

Array = Any

def isa_name() -> str: ...
def supported_isas() -> list[str]: ...
def set_isa(name: str) -> None: ...
def set_threads(n: int) -> None: ...
def threads() -> int: ...
def idle_workers() -> None: ...
def tile_size() -> list[int]: ...
def project_forward(
    view: Array,
    means: Array,
    quats: Array,
    scales: Array,
    means2d: Array,
    conics: Array,
    z: Array,
    radii: Array,
    slopes: Array | None,
) -> None: ...
def project_backward(
    view: Array,
    means: Array,
    quats: Array,
    scales: Array,
    radii: Array,
    g_means2d: Array,
    g_conics: Array,
    g_z: Array,
    g_means: Array,
    g_quats: Array,
    g_scales: Array,
    g_twist: Array,
) -> None: ...
def adam_settle(
    params: Array,
    moment1: Array,
    moment2: Array,
    last_step: Array,
    rates: Array,
    beta1: float,
    beta2: float,
    epsilon: float,
    step: int,
) -> None: ...
def ssim_cache_floats(width: int, height: int) -> int: ...
def ssim_target(target: Array, mask: Array | None, width: int, height: int, cache: Array) -> None: ...
def ssim(
    image: Array,
    target: Array,
    cache: Array,
    width: int,
    height: int,
    mask: Array | None,
    weight: float,
    gradient: Array,
) -> float: ...
def mapping_losses(
    sums: Array,
    median_depth: Array | None,
    moment: Array | None,
    alpha: Array | None,
    target_color: Array,
    target_depth: Array,
    height: int,
    weights: list[float],
    valid_pixels: float,
    g_sums: Array,
    g_median_depth: Array | None,
    g_moment: Array | None,
    g_alpha: Array | None,
    losses: Array,
) -> None: ...
def tracking_loss(
    sums: Array,
    alpha: Array,
    target_color: Array,
    target_depth: Array,
    width: int,
    height: int,
    options: list[float],
    uncertainty: bool,
    kept: bool,
    gain: float,
    offset: float,
    g_sums: Array,
    g_exposure: Array,
) -> float: ...
def reference_maps(
    sums: Array,
    alpha: Array,
    moment: Array | None,
    width: int,
    height: int,
    options: list[float],
    uncertainty: bool,
    gray: Array,
    depth: Array,
    weight_gray: Array,
    weight_depth: Array,
) -> None: ...
def align_steps(level: Level, T: Array, whole: int, normal: Array) -> None: ...
def align_images(
    levels: list[Level],
    iterations: int,
    update_stop: float,
    plateau_stop: float,
    depth_m: float,
    degenerate_share: float,
    min_pixels: float,
    T: Array,
    sums: Array,
) -> tuple[int, int]: ...
def mesh_depth(
    u: Array, v: Array, z: Array, faces: Array, width: int, height: int, near_m: float, depth: Array, face: Array
) -> None: ...
def halve_color(color: Array, half: Array) -> None: ...
def resize_depth(
    depth: Array,
    row_pixels: Array,
    row_share: Array,
    column_pixels: Array,
    column_share: Array,
    same_surface: float,
    area_rows: Array,
    area_columns: Array,
    least_m: float,
    most_m: float,
    resized: Array,
) -> None: ...
def image_planes(color: Array, depth: Array, color_planes: Array, depth_plane: Array) -> int: ...
def gray(color: Array, luma: list[float], gray: Array) -> None: ...
def halve(image: Array, half: Array) -> None: ...
def halve_depth(depth: Array, step_m: float, half: Array) -> None: ...
def noise_scale(depth: Array, rules: list[float]) -> float: ...
def compare(
    reference_depth: Array,
    reference_gray: Array,
    live_depth: Array,
    live_gray: Array,
    intrinsics: list[float],
    T_live_reference: Array,
    rules: list[float],
    found: Array,
    color_depth: Array | None = None,
    readouts: list[float] = ...,
) -> bool: ...
def free_places(
    points: Array,
    T_camera_points: Array,
    depth: Array,
    intrinsics: list[float],
    radius_px: int,
    clear_m: float,
    clear_relative: float,
    free: Array,
) -> None: ...
def read_before(
    depth: Array,
    intrinsics: list[float],
    readout: list[float],
    rounds: int,
    same_surface: float,
    usual_m: float,
    before: Array,
    color_at: Array | None = None,
) -> None: ...

class Level:
    def __init__(
        self,
        reference_gray: Array,
        reference_depth: Array,
        weight_gray: Array | None,
        weight_depth: Array | None,
        live_gray: Array,
        live_depth: Array,
        intrinsics: list[float],
        options: list[float],
        noise: Array | None = None,
        color_depth: Array | None = None,
        readouts: list[float] = ...,
    ) -> None: ...

class Harmonics:
    def __init__(
        self, params: Array, moment1: Array, moment2: Array, last_step: Array, degree: int, step: int, rate: float
    ) -> None: ...

class Rasteriser:
    def __init__(self) -> None: ...
    def blend_forward(
        self,
        means2d: Array,
        conics: Array,
        z: Array,
        radii: Array,
        opacities: Array,
        features: Array,
        width: int,
        height: int,
        alpha_min: float,
        stop: float,
        reference: Array | None,
        sums: Array,
        moment: Array | None,
        alpha: Array,
        median_id: Array | None,
        median_weight: Array | None,
        dominant_id: Array | None,
        dominant_weight: Array | None,
    ) -> None: ...
    def blend_backward(
        self,
        g_sums: Array,
        g_moment: Array | None,
        g_alpha: Array | None,
        g_means2d: Array,
        g_conics: Array,
        g_z: Array,
        g_opacities: Array,
        g_features: Array,
    ) -> None: ...
    def gather(self, planes: Array, sums: Array) -> None: ...
    def view_forward(
        self,
        view: Array,
        params: Array,
        harmonics: Harmonics | None,
        k: int,
        alpha_min: float,
        stop: float,
        ray_depth: bool,
        reference: Array | None,
        sums: Array,
        moment: Array | None,
        alpha: Array,
        median_id: Array | None,
        median_weight: Array | None,
        dominant_id: Array | None,
        dominant_weight: Array | None,
        median_depth: Array | None,
        seconds: Array,
    ) -> None: ...
    def view_backward(
        self,
        params: Array,
        g_sums: Array,
        g_moment: Array | None,
        g_alpha: Array | None,
        median_id: Array | None,
        g_median_depth: Array | None,
        g_params: Array,
        pull: Array | None,
        g_twist: Array,
        seconds: Array,
    ) -> None: ...
    def step(
        self,
        params: Array,
        moment1: Array,
        moment2: Array,
        last_step: Array,
        g_sums: Array,
        g_moment: Array | None,
        g_alpha: Array | None,
        median_id: Array | None,
        g_median_depth: Array | None,
        rates: Array,
        beta1: float,
        beta2: float,
        epsilon: float,
        step: int,
        isotropy: list[float],
        frozen_colors: int,
        harmonics: Harmonics | None,
        pull: Array | None,
        g_twist: Array,
        seconds: Array,
    ) -> float: ...
    def backward_pose(self, params: Array, g_sums: Array, g_twist: Array, seconds: Array) -> None: ...
    def visible(self, out: Array) -> None: ...
