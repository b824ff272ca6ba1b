"""Draw when a sensor reads: what the alignments of keyframes cost at other times, and the times with their errors."""

from PIL import Image, ImageDraw, ImageFont

from sigmasplat.api import Matrix, SensorTimes
from sigmasplat.plugins.outputs.drawing.plot import ACCENT, BLUE, DARK, nice_ticks
from sigmasplat.plugins.outputs.drawing.view_panels import BACKGROUND, FAINT, TEXT

NAMES = ("depth after colour", "depth, first to last row", "colour, first to last row")
WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 720, 520, 52, 672, 112, 456
"""Size of a chart and ends of its axes; it is drawn twice as large, because PIL does not smooth lines."""


def draw_sensor_times(times: SensorTimes, costs: Matrix) -> Image.Image:
    """Draw a chart of each time: its cost, and a bar of two standard deviations to both sides.

    costs [3, N, 2]: seconds, and the cost there as a multiple of the lowest one.
    """
    image = Image.new("RGB", (3 * WIDTH, HEIGHT), BACKGROUND)
    values_s = times.depth_late_s, times.depth_rows_s, times.color_rows_s
    for k, (name, value_s, std_s) in enumerate(zip(NAMES, values_s, times.std_s or (0.0,) * 3, strict=True)):
        image.paste(_chart(name, costs[k] * [1e3, 100.0], 1e3 * value_s, 1e3 * std_s), (k * WIDTH, 0))
    return image.resize((3 * WIDTH // 2, HEIGHT // 2), Image.Resampling.LANCZOS)


def _chart(name: str, curve: Matrix, value_ms: float, std_ms: float) -> Image.Image:
    image = Image.new("RGB", (WIDTH, HEIGHT), BACKGROUND)
    draw, font, small = ImageDraw.Draw(image), ImageFont.load_default(30), ImageFont.load_default(24)
    (first, low), (last, high) = curve.min(0).tolist(), curve.max(0).tolist()

    def place(ms: float, cost: float = low) -> tuple[float, float]:
        x, y = (ms - first) / (last - first), (cost - low) / max(high - low, 0.1)
        return LEFT + x * (RIGHT - LEFT), BOTTOM - y * (BOTTOM - TOP)

    for ms in nice_ticks(first, last, 4).tolist():
        x, _ = place(ms)
        draw.line((x, TOP, x, BOTTOM), FAINT, 1 if ms else 4)
        draw.text((x, BOTTOM + 36), f"{ms:g} ms", FAINT, small, anchor="mm")
    draw.line([place(*point) for point in curve.tolist()], DARK[BLUE], 4, joint="curve")
    (x, y), (end, _) = place(value_ms), place(value_ms + 2.0 * std_ms)
    draw.line((2.0 * x - end, y, end, y), DARK[ACCENT], 10)
    draw.line((x, y - 18, x, y + 18), DARK[ACCENT], 4)
    draw.text((LEFT, 32), f"{name}: {value_ms:.1f} ± {std_ms:.1f} ms", TEXT, font, anchor="lm")
    words = f"cost, up to {high - low:.1f} % above the lowest; bar: ± 2 std. deviations"
    draw.text((LEFT, 76), words, FAINT, small, anchor="lm")
    return image
