// Python bindings of the kernels that prepare and compare images. They keep the interpreter lock: each takes less than
// the time that another thread may hold the lock when it is requested again.
#include <vector>

#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include "bind.h"

using namespace sigmasplat;

static ResizedAxis axis_of(const ConstInts& pixels, const ConstFloats& share, int source) {
    need(pixels.ndim() == 2 && pixels.shape(0) == 3 && pixels.shape(1) == share.size(), "an axis has three source pixels and a share per pixel");
    const size_t n = share.size();
    return {int(n), source, pixels.data(), pixels.data() + n, pixels.data() + 2 * n, share.data()};
}
static CompareRules rules_of(const std::vector<double>& v) {
    need(v.size() == 8 && v[0] >= 1, "a comparison has eight rules");
    return {int(v[0]), int(v[1]), v[2], v[3], v[4], v[5], v[6], v[7]};
}
static void need_image(const ConstFloats& a) { need(a.ndim() == 2 && a.size() > 0, "an image is [H, W]"); }

static void halve_color(ConstFloats color, Floats half) {
    need(half.ndim() == 3 && half.size() > 0 && half.shape(2) == 3 && color.ndim() == 3 && color.shape(2) == 3 && color.shape(0) == 2 * half.shape(0)
         && color.shape(1) == 2 * half.shape(1), "halve_color: [2h, 2w, 3] to [h, w, 3]");
    active->images->halve_color(color.data(), int(half.shape(1)), int(half.shape(0)), half.data());
}
static void resize_depth(ConstFloats depth, ConstInts row_pixels, ConstFloats row_share, ConstInts column_pixels, ConstFloats column_share,
                         float same_surface, ConstInts area_rows, ConstInts area_columns, float least_m, float most_m, Floats resized) {
    need_image(depth);
    const ResizedAxis rows = axis_of(row_pixels, row_share, int(depth.shape(0))), columns = axis_of(column_pixels, column_share, int(depth.shape(1)));
    need(resized.ndim() == 2 && resized.shape(0) == size_t(rows.size) && resized.shape(1) == size_t(columns.size), "resize_depth: the axes have other sizes");
    need(area_rows.ndim() == 2 && area_columns.ndim() == 2 && area_rows.shape(0) == area_columns.shape(0) && area_rows.shape(1) == size_t(rows.size)
         && area_columns.shape(1) == size_t(columns.size), "resize_depth: the area has other sizes");
    active->images->resize_depth(depth.data(), rows, columns, same_surface, {int(area_rows.shape(0)), area_rows.data(), area_columns.data()}, {least_m, most_m}, resized.data());
}
static int64_t image_planes(ConstFloats color, ConstFloats depth, Floats color_planes, Floats depth_plane) {
    need_image(depth);
    need(color.ndim() == 3 && color.shape(2) == 3 && color.shape(0) == depth.shape(0) && color.shape(1) == depth.shape(1), "image_planes: colour and depth differ in size");
    need(depth_plane.ndim() == 2 && color_planes.size() == 3 * depth_plane.size() && depth_plane.shape(0) >= depth.shape(0)
         && depth_plane.shape(1) >= depth.shape(1), "image_planes: the planes are too small");
    return active->images->image_planes(color.data(), depth.data(), int(depth.shape(1)), int(depth.shape(0)), int(depth_plane.shape(0)),
                                        int(depth_plane.shape(1)), color_planes.data(), depth_plane.data());
}
static void gray(ConstFloats color, std::vector<float> luma, Floats gray) {
    need(luma.size() == 3 && color.size() == 3 * gray.size(), "gray: [H, W, 3] to [H, W]");
    active->images->gray(color.data(), int64_t(gray.size()), luma[0], luma[1], luma[2], gray.data());
}
static void need_half(const ConstFloats& image, const Floats& half) {
    need(image.ndim() == 2 && half.ndim() == 2 && half.shape(0) == image.shape(0) / 2 && half.shape(1) == image.shape(1) / 2, "halve: [h, w] to [h/2, w/2]");
}
static bool compare(ConstFloats reference_depth, ConstFloats reference_gray, ConstFloats live_depth, ConstFloats live_gray,
                    std::vector<double> intrinsics, ConstDoubles T, std::vector<double> rules, Doubles found, Maybe<ConstFloats> color_depth,
                    const std::vector<float>& readouts) {
    need_image(reference_depth);
    need(reference_gray.size() == reference_depth.size() && live_depth.size() == reference_depth.size() && live_gray.size() == reference_depth.size()
         && (!color_depth || color_depth->size() == reference_depth.size()), "compare: images of one size");
    need(intrinsics.size() == 4 && T.size() >= 12 && found.size() == COMPARED, "compare: four intrinsics, a pose, eight values");
    const std::optional<AlignReadouts> read = readouts_of(readouts);
    return active->images->compare({reference_depth.data(), reference_gray.data(), live_depth.data(), live_gray.data(), int(reference_depth.shape(1)), int(reference_depth.shape(0)),
                                    intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3], color_depth ? color_depth->data() : nullptr}, T.data(), read ? &*read : nullptr, rules_of(rules), found.data());
}
static void free_places(nb::ndarray<const float, nb::ndim<2>, nb::device::cpu> points, ConstDoubles T, ConstFloats depth, std::vector<double> intrinsics,
                        int radius_px, double clear_m, double clear_relative, Bytes free) {
    need_image(depth);
    need(points.shape(0) == 3 && free.size() == points.shape(1), "free_places: points [3, n] and a byte for each");
    need(T.size() >= 12 && intrinsics.size() == 4 && radius_px >= 0, "free_places: a pose, four intrinsics, a radius of at least 0");
    const float* x = points.data();
    const int64_t row = points.stride(0);
    active->images->free_places({x, x + row, x + 2 * row, int64_t(points.shape(1)), points.stride(1)}, T.data(),
                                {depth.data(), int(depth.shape(1)), int(depth.shape(0)), intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]},
                                {radius_px, clear_m, clear_relative}, free.data());
}
static void read_before(ConstFloats depth, std::vector<double> intrinsics, const std::vector<float>& readout, int rounds, float same_surface, float usual_m,
                        Floats before, Maybe<Floats> color_at) {
    need_image(depth);
    need(intrinsics.size() == 4 && readout.size() == sizeof(Readout) / sizeof(float) && rounds > 0, "read_before: four intrinsics, a readout, a round");
    need(before.size() == depth.size() && (!color_at || color_at->size() == 2 * depth.size()), "read_before: images of one size");
    Readout read;
    std::memcpy(&read, readout.data(), sizeof read);
    active->images->read_before({depth.data(), int(depth.shape(1)), int(depth.shape(0)), intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]}, read,
                                {rounds, same_surface, usual_m}, before.data(), color_at ? color_at->data() : nullptr);
}

void sigmasplat::bind_images(nb::module_& m) {
    m.def("halve_color", halve_color);
    m.def("resize_depth", resize_depth);
    m.def("image_planes", image_planes);
    m.def("gray", gray);
    m.def("halve", [](ConstFloats image, Floats half) {
        need_half(image, half);
        active->images->halve(image.data(), int(image.shape(1)), int(image.shape(0)), half.data());
    });
    m.def("halve_depth", [](ConstFloats depth, float step_m, Floats half) {
        need_half(depth, half);
        active->images->halve_depth(depth.data(), int(depth.shape(1)), int(depth.shape(0)), step_m, half.data());
    });
    m.def("noise_scale", [](ConstFloats depth, std::vector<double> rules) {
        need_image(depth);
        return active->images->noise_scale(depth.data(), int(depth.shape(1)), int(depth.shape(0)), rules_of(rules));
    });
    m.def("compare", compare, nb::arg("reference_depth"), nb::arg("reference_gray"), nb::arg("live_depth"), nb::arg("live_gray"), nb::arg("intrinsics"),
          nb::arg("T_live_reference"), nb::arg("rules"), nb::arg("found"), nb::arg("color_depth").none() = nb::none(), nb::arg("readouts") = std::vector<float>());
    m.def("free_places", free_places);
    m.def("read_before", read_before, nb::arg("depth"), nb::arg("intrinsics"), nb::arg("readout"), nb::arg("rounds"), nb::arg("same_surface"), nb::arg("usual_m"),
          nb::arg("before"), nb::arg("color_at").none() = nb::none());
}
