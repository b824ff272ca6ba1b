// Python bindings of the kernels: arrays in, arrays out, no copies, the GIL released; the instruction set is chosen at
// run time.
#include <cstring>
#include <memory>
#include <string>
#include <vector>

#include <omp.h>
#ifdef __linux__
#include <sched.h>
#endif

#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "bind.h"
#include "mesh.h"

namespace sigmasplat {
#if defined(SIGMASPLAT_HAS_avx2)
namespace avx512 { extern const Kernels table; }
namespace avx2 { extern const Kernels table; }
#endif
namespace baseline { extern const Kernels table; }
}  // namespace sigmasplat

using namespace sigmasplat;

static std::vector<const Kernels*> supported() {
    std::vector<const Kernels*> found;
#if defined(SIGMASPLAT_HAS_avx2)
    __builtin_cpu_init();
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512dq"))
        found.push_back(&avx512::table);
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) found.push_back(&avx2::table);
#endif
    found.push_back(&baseline::table);
    return found;
}
const Kernels* sigmasplat::active = supported().front();

template <class A> static auto* pointer(Maybe<A>& a) { return a ? a->data() : nullptr; }
static Outputs outputs(Floats& sums, Maybe<Floats>& moment, Floats& alpha, Maybe<Ints>& median_id, Maybe<Floats>& median_weight,
                       Maybe<Ints>& dominant_id, Maybe<Floats>& dominant_weight) {
    return {sums.data(), pointer(moment), alpha.data(), pointer(median_id), pointer(median_weight), pointer(dominant_id), pointer(dominant_weight)};
}

// One level of two images to align, and the weights of its residuals. Keeps references to the arrays.
struct Level {
    ConstFloats reference_gray, reference_depth;
    Maybe<ConstFloats> weight_gray, weight_depth;
    ConstFloats live_gray, live_depth;
    std::vector<float> intrinsics;
    AlignOptions options;
    Maybe<ConstFloats> noise, color_depth;
    std::optional<AlignReadouts> readouts;

    Level(ConstFloats rg, ConstFloats rd, Maybe<ConstFloats> wg, Maybe<ConstFloats> wd, ConstFloats lg, ConstFloats ld, std::vector<float> camera, std::vector<float> o,
          Maybe<ConstFloats> noise_factor, Maybe<ConstFloats> cd, const std::vector<float>& read)
        : reference_gray(rg), reference_depth(rd), weight_gray(wg), weight_depth(wd), live_gray(lg), live_depth(ld), intrinsics(camera), noise(noise_factor), color_depth(cd), readouts(readouts_of(read)) {
        need(camera.size() == 4 && o.size() == 6, "a level has 4 intrinsics and 6 options");
        need(rg.ndim() == 2 && rd.size() == rg.size() && lg.size() == rg.size() && ld.size() == rg.size()
             && (!wg || wg->size() == rg.size()) && (!wd || wd->size() == rg.size()) && (!noise || noise->size() == rg.size()) && (!cd || cd->size() == rg.size()), "the planes of a level are of one size");
        options = {o[0], o[1], o[2], o[3], o[4], o[5]};
    }
    const AlignReadouts* read() const { return readouts ? &*readouts : nullptr; }
    AlignLevel planes() const {
        return {{reference_gray.data(), reference_depth.data(), weight_gray ? weight_gray->data() : nullptr, weight_depth ? weight_depth->data() : nullptr,
                 live_gray.data(), live_depth.data(), noise ? noise->data() : nullptr, color_depth ? color_depth->data() : nullptr},
                {int(reference_gray.shape(1)), int(reference_gray.shape(0)), intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]}};
    }
};

// The harmonics of the splats, with Adam's state and the number and rate of the step. Keeps references to the arrays.
struct Harmonics {
    Floats params, moment1, moment2;
    Ints last_step;
    int degree, step;
    float rate;

    Harmonics(Floats p, Floats m1, Floats m2, Ints last, int degree_used, int number, float learning_rate)
        : params(p), moment1(m1), moment2(m2), last_step(last), degree(degree_used), step(number), rate(learning_rate) {
        need(p.ndim() == 2 && p.shape(1) == 45 && degree >= 1 && degree <= 3, "harmonics are [N, 45], of degree 1 to 3");
        need(last.size() == p.shape(0) && m1.size() == p.size() && m2.size() == p.size(), "Adam's state must fit the rows");
    }
    ViewColors colors() const { return {params.data(), degree}; }
    HarmonicsStep stepped() const {
        return {params.data(), {moment1.data(), moment2.data(), last_step.data()}, degree, step, rate};
    }
};
static void need_rows(const Harmonics* h, size_t n) { need(!h || h->params.shape(0) == n, "harmonics must fit the rows"); }

static TrackOptions track_options(const std::vector<float>& v, bool uncertainty, bool kept = false) {
    need(v.size() == 7, "tracking has seven numbers");
    return {v[0], v[1], v[2], v[3], v[4], v[5], v[6], uncertainty, kept};
}

// The buffers of one render, for the instruction set that was active when it was made.
class Rasteriser {
public:
    Rasteriser() : kernels(active), context(kernels->create()) {}
    ~Rasteriser() { kernels->destroy(context); }
    Rasteriser(const Rasteriser&) = delete;

    void blend_forward(ConstFloats means2d, ConstFloats conics, ConstFloats z, ConstFloats radii, ConstFloats opacities,
                       ConstFloats features, int width, int height, float alpha_min, float stop, Maybe<ConstFloats> reference,
                       Floats sums, Maybe<Floats> moment, Floats alpha, Maybe<Ints> median_id, Maybe<Floats> median_weight,
                       Maybe<Ints> dominant_id, Maybe<Floats> dominant_weight) {
        const Outputs o = outputs(sums, moment, alpha, median_id, median_weight, dominant_id, dominant_weight);
        const int64_t n = z.shape(0);
        const int k = int(features.shape(1));
        need(k >= 1 && k <= 16, "blend takes 1 to 16 features at once");
        need(!o.moment == !reference, "a moment needs a reference depth");
        nb::gil_scoped_release unlocked;
        kernels->blend_forward(context, means2d.data(), conics.data(), z.data(), radii.data(), opacities.data(), features.data(),
                               n, k, width, height, pointer(reference), {alpha_min, stop}, o);
    }
    void blend_backward(ConstFloats g_sums, Maybe<ConstFloats> g_moment,
                        Maybe<ConstFloats> g_alpha, Floats g_means2d, Floats g_conics, Floats g_z, Floats g_opacities, Floats g_features) {
        nb::gil_scoped_release unlocked;
        kernels->blend_backward(context, {g_sums.data(), pointer(g_moment), pointer(g_alpha)},
                                {g_means2d.data(), g_conics.data(), g_z.data(), g_opacities.data(), g_features.data()});
    }
    void gather(ConstFloats planes, Floats sums) {
        need(planes.ndim() == 3 && sums.ndim() == 2 && planes.shape(0) >= sums.shape(1) && sums.shape(1) <= 16, "gather sums at most 16 planes");
        nb::gil_scoped_release unlocked;
        kernels->gather(context, planes.data(), int(sums.shape(1)), sums.data());
    }
    void view_forward(ConstFloats view, ConstFloats params, const Harmonics* harmonics, int k, float alpha_min, float stop, bool ray_depth, Maybe<ConstFloats> reference,
                      Floats sums, Maybe<Floats> moment, Floats alpha, Maybe<Ints> median_id, Maybe<Floats> median_weight,
                      Maybe<Ints> dominant_id, Maybe<Floats> dominant_weight, Maybe<Floats> median_depth, Doubles seconds) {
        Outputs o = outputs(sums, moment, alpha, median_id, median_weight, dominant_id, dominant_weight);
        o.median_depth = pointer(median_depth);
        need(params.ndim() == 2 && params.shape(1) == 17, "params must be [N, 17]");
        need(k == 4 || k == 7, "a view has 4 features (colour, depth) or 7 (and variance)");
        need(!o.moment == !reference, "a moment needs a reference depth");
        need(seconds.size() >= 3, "seconds needs 3 places");
        need_rows(harmonics, params.shape(0));
        nb::gil_scoped_release unlocked;
        kernels->view_forward(context, view.data(), params.data(), harmonics ? harmonics->colors() : ViewColors{}, int64_t(params.shape(0)), k, pointer(reference),
                              {alpha_min, stop, ray_depth}, o, seconds.data());
    }
    void view_backward(ConstFloats params, ConstFloats g_sums, Maybe<ConstFloats> g_moment, Maybe<ConstFloats> g_alpha, Maybe<Ints> median_id, Maybe<ConstFloats> g_median_depth,
                       Floats g_params, Maybe<Floats> pull, Doubles g_twist, Doubles seconds) {
        need(g_twist.size() == 6 && seconds.size() >= 2, "g_twist has 6 numbers, seconds 2");
        need(!median_id == !g_median_depth, "a median depth's gradient goes with the medians");
        need(!pull || pull->size() == params.shape(0), "pull must fit the rows");
        nb::gil_scoped_release unlocked;
        kernels->view_backward(context, params.data(), {g_sums.data(), pointer(g_moment), pointer(g_alpha), pointer(median_id), pointer(g_median_depth)},
                               g_params.data(), pointer(pull), g_twist.data(), seconds.data());
    }
    double step(Floats params, Floats moment1, Floats moment2, Ints last_step, ConstFloats g_sums, Maybe<ConstFloats> g_moment,
                Maybe<ConstFloats> g_alpha, Maybe<Ints> median_id, Maybe<ConstFloats> g_median_depth, ConstFloats rates, float beta1, float beta2,
                float epsilon, int step, std::vector<float> isotropy, int64_t frozen_colors, const Harmonics* harmonics,
                Maybe<Floats> pull, Doubles g_twist, Doubles seconds) {
        need_rows(harmonics, params.shape(0));
        need(isotropy.size() == 2 && !median_id == !g_median_depth, "a step has two isotropy weights; a median depth's gradient goes with the medians");
        need(!pull || pull->size() == params.shape(0), "pull must fit the rows");
        need(g_twist.size() == 6 && seconds.size() >= 2 && rates.size() == 17, "g_twist has 6 numbers, seconds 2, rates 17");
        need(last_step.size() == params.shape(0) && moment1.size() == params.size() && moment2.size() == params.size(), "Adam's state must fit the rows");
        nb::gil_scoped_release unlocked;
        return kernels->view_step(context, params.data(), {g_sums.data(), pointer(g_moment), pointer(g_alpha), pointer(median_id), pointer(g_median_depth)},
                                  {moment1.data(), moment2.data(), last_step.data()}, {rates.data(), beta1, beta2, epsilon, step},
                                  {isotropy[0], isotropy[1], frozen_colors}, harmonics ? harmonics->stepped() : HarmonicsStep{}, pointer(pull), g_twist.data(), seconds.data());
    }
    void backward_pose(ConstFloats params, ConstFloats g_sums, Doubles g_twist, Doubles seconds) {
        need(g_twist.size() == 6 && seconds.size() >= 1, "g_twist has 6 numbers, seconds 1");
        nb::gil_scoped_release unlocked;
        kernels->view_backward_pose(context, params.data(), {g_sums.data(), nullptr, nullptr}, g_twist.data(), seconds.data());
    }
    void visible(Bytes out) const {
        nb::gil_scoped_release unlocked;
        kernels->view_visible(context, out.data());
    }

private:
    const Kernels* kernels;
    Context* context;
};

// Give the other threads of the calling thread's team the priority of idle time: any other thread takes their core at once.
static void idle_workers() {
#ifdef __linux__
#pragma omp parallel
    if (omp_get_thread_num()) {
        const sched_param none{};
        sched_setscheduler(0, SCHED_IDLE, &none);
    }
#endif
}

NB_MODULE(_core, m) {
    nb::set_leak_warnings(false);         // autograd graphs can outlive the interpreter's orderly shutdown
    m.doc() = "SigmaSplat's CPU kernels. Arrays are float32, C-contiguous, on the CPU; see sigmasplat.render.cpu for the shapes.";
    m.def("isa_name", [] { return std::string(active->name); });
    m.def("supported_isas", [] { std::vector<std::string> names; for (auto* k : supported()) names.push_back(k->name); return names; });
    m.def("set_isa", [](const std::string& name) {
        for (auto* k : supported()) if (name == k->name || name == "auto") { active = k; return; }
        throw std::invalid_argument("instruction set " + name + " is not supported on this machine");
    });
    m.def("set_threads", [](int n) { omp_set_num_threads(n); });
    m.def("threads", [] { return omp_get_max_threads(); });
    m.def("idle_workers", idle_workers, nb::call_guard<nb::gil_scoped_release>());
    m.def("tile_size", [] { return std::vector<int>{active->pad.tile_width, active->pad.tile_height}; });
    m.def("project_forward", [](ConstFloats view, ConstFloats means, ConstFloats quats, ConstFloats scales, Floats means2d, Floats conics, Floats z, Floats radii, Maybe<Floats> slopes) {
        nb::gil_scoped_release unlocked;
        active->project_forward(view.data(), means.data(), quats.data(), scales.data(), int64_t(means.shape(0)), means2d.data(), conics.data(), z.data(), radii.data(), pointer(slopes));
    }, nb::arg("view"), nb::arg("means"), nb::arg("quats"), nb::arg("scales"), nb::arg("means2d"), nb::arg("conics"), nb::arg("z"), nb::arg("radii"), nb::arg("slopes").none());
    m.def("project_backward", [](ConstFloats view, ConstFloats means, ConstFloats quats, ConstFloats scales, ConstFloats radii, ConstFloats g_means2d,
                                 ConstFloats g_conics, ConstFloats g_z, Floats g_means, Floats g_quats, Floats g_scales, Doubles g_twist) {
        nb::gil_scoped_release unlocked;
        active->project_backward(view.data(), means.data(), quats.data(), scales.data(), int64_t(means.shape(0)), radii.data(), g_means2d.data(),
                                 g_conics.data(), g_z.data(), g_means.data(), g_quats.data(), g_scales.data(), g_twist.data());
    });
    m.def("adam_settle", [](Floats params, Floats moment1, Floats moment2, Ints last_step, ConstFloats rates, float beta1, float beta2, float epsilon, int step) {
        need(rates.size() == 17 && last_step.size() == params.shape(0) && moment1.size() == params.size() && moment2.size() == params.size(), "Adam's state must fit the rows");
        nb::gil_scoped_release unlocked;
        active->adam_settle(params.data(), int64_t(params.shape(0)), {moment1.data(), moment2.data(), last_step.data()}, {rates.data(), beta1, beta2, epsilon, step});
    });
    m.def("ssim_cache_floats", [](int width, int height) { const size_t w = active->pad.lanes; return 6 * ((width + w - 1) / w * w) * height; });
    m.def("ssim_target", [](ConstFloats target, Maybe<ConstFloats> mask, int width, int height, Floats cache) {
        nb::gil_scoped_release unlocked;
        active->ssim_target(target.data(), pointer(mask), width, height, target.shape(2), target.shape(1) * target.shape(2), cache.data());
    }, nb::arg("target"), nb::arg("mask").none(), nb::arg("width"), nb::arg("height"), nb::arg("cache"));
    m.def("ssim", [](ConstFloats image, ConstFloats target, ConstFloats cache, int width, int height, Maybe<ConstFloats> mask, float weight, Floats gradient) {
        nb::gil_scoped_release unlocked;
        return active->ssim(image.data(), target.data(), cache.data(), width, height, image.shape(2), image.shape(1) * image.shape(2), pointer(mask), weight, gradient.data());
    }, nb::arg("image"), nb::arg("target"), nb::arg("cache"), nb::arg("width"), nb::arg("height"), nb::arg("mask").none(), nb::arg("weight"), nb::arg("gradient"));
    m.def("mapping_losses", [](ConstFloats sums, Maybe<ConstFloats> median_depth, Maybe<ConstFloats> moment, Maybe<ConstFloats> alpha,
                               ConstFloats target_color, ConstFloats target_depth, int height, std::vector<float> weights, double valid_pixels, Floats g_sums,
                               Maybe<Floats> g_median_depth, Maybe<Floats> g_moment, Maybe<Floats> g_alpha, Doubles losses) {
        need(weights.size() == LOSS_TERMS && losses.size() == LOSS_TERMS, "mapping_losses: seven weights, seven losses");
        need(!median_depth == !g_median_depth && !moment == !g_moment && !alpha == !g_alpha, "a gradient goes with its plane");
        const size_t stride = sums.shape(2), plane = sums.shape(1) * stride;
        const LossWeights w{weights[0], weights[1], weights[2], weights[3], weights[4], weights[5], weights[6]};
        nb::gil_scoped_release unlocked;
        active->mapping_losses(sums.data(), target_color.data(), target_depth.data(), height, stride, plane, sums.shape(0) >= 7,
                               {pointer(median_depth), pointer(moment), pointer(alpha)}, w, valid_pixels,
                               g_sums.data(), {pointer(g_median_depth), pointer(g_moment), pointer(g_alpha)}, losses.data());
    }, nb::arg("sums"), nb::arg("median_depth").none(), nb::arg("moment").none(), nb::arg("alpha").none(), nb::arg("target_color"), nb::arg("target_depth"),
       nb::arg("height"), nb::arg("weights"), nb::arg("valid_pixels"), nb::arg("g_sums"), nb::arg("g_median_depth").none(), nb::arg("g_moment").none(),
       nb::arg("g_alpha").none(), nb::arg("losses"));
    m.def("tracking_loss", [](ConstFloats sums, ConstFloats alpha, ConstFloats target_color, ConstFloats target_depth, int width, int height,
                              std::vector<float> options, bool uncertainty, bool kept, float gain, float offset, Floats g_sums, Doubles g_exposure) {
        need(g_exposure.size() == 2, "g_exposure has 2 numbers");
        const Plane plane{width, height, sums.shape(2), sums.shape(1) * sums.shape(2)};
        const TrackOptions o = track_options(options, uncertainty, kept);
        nb::gil_scoped_release unlocked;
        return active->tracking_loss(sums.data(), alpha.data(), sums.shape(0) >= 7, target_color.data(), target_depth.data(), plane, o, gain, offset,
                                     g_sums.data(), g_exposure.data());
    });
    m.def("reference_maps", [](ConstFloats sums, ConstFloats alpha, Maybe<ConstFloats> moment, int width, int height, std::vector<float> options,
                               bool uncertainty, Floats gray, Floats depth, Floats weight_gray, Floats weight_depth) {
        const Plane plane{width, height, sums.shape(2), sums.shape(1) * sums.shape(2)};
        const TrackOptions o = track_options(options, uncertainty);
        nb::gil_scoped_release unlocked;
        active->reference_maps(sums.data(), alpha.data(), pointer(moment), sums.shape(0) >= 7, plane, o, gray.data(), depth.data(),
                               weight_gray.data(), weight_depth.data());
    }, nb::arg("sums"), nb::arg("alpha"), nb::arg("moment").none(), nb::arg("width"), nb::arg("height"), nb::arg("options"), nb::arg("uncertainty"),
       nb::arg("gray"), nb::arg("depth"), nb::arg("weight_gray"), nb::arg("weight_depth"));
    m.def("mesh_depth", [](ConstDoubles u, ConstDoubles v, ConstDoubles z, ConstInts faces, int width, int height, double near_m, Floats depth, Ints face) {
        need(u.size() == z.size() && v.size() == z.size() && faces.ndim() == 2 && faces.shape(1) == 3, "mesh_depth: [V] three times, [F, 3]");
        need(depth.size() == size_t(width) * height && face.size() == depth.size(), "mesh_depth: two images");
        nb::gil_scoped_release unlocked;
        mesh_depth({u.data(), v.data(), z.data(), faces.data(), faces.shape(0)}, width, height, near_m, depth.data(), face.data());
    });
    nb::class_<Level>(m, "Level")
        .def(nb::init<ConstFloats, ConstFloats, Maybe<ConstFloats>, Maybe<ConstFloats>, ConstFloats, ConstFloats, std::vector<float>, std::vector<float>, Maybe<ConstFloats>, Maybe<ConstFloats>, std::vector<float>>(),
             nb::arg("reference_gray"), nb::arg("reference_depth"), nb::arg("weight_gray").none(), nb::arg("weight_depth").none(), nb::arg("live_gray"),
             nb::arg("live_depth"), nb::arg("intrinsics"), nb::arg("options"), nb::arg("noise").none() = nb::none(), nb::arg("color_depth").none() = nb::none(), nb::arg("readouts") = std::vector<float>());
    m.def("align_steps", [](const Level& level, ConstDoubles T, int whole, Doubles normal) {
        const int count = int(T.size() / 16);
        need(T.size() == 16 * size_t(count) && normal.size() == 55 * size_t(count), "align_steps: wrong sizes");
        const AlignLevel planes = level.planes();
        nb::gil_scoped_release unlocked;
        active->align_steps(&planes, &level.options, level.read(), count, whole, T.data(), normal.data());
    });
    m.def("align_images", [](const std::vector<Level*>& levels, int iterations, double update_stop, double plateau_stop, double depth_m, double degenerate_share,
                             double min_pixels, Doubles T, Doubles found) {
        need(!levels.empty() && T.size() >= 12 && found.size() == 6, "align_images: wrong sizes");
        std::vector<AlignLevel> planes;
        std::vector<AlignOptions> options;
        for (auto* level : levels) { planes.push_back(level->planes()); options.push_back(level->options); }
        int degenerate = 6, steps;
        {
            nb::gil_scoped_release unlocked;
            steps = active->align_images(planes.data(), options.data(), levels[0]->read(), int(planes.size()), {iterations, update_stop, plateau_stop, depth_m, degenerate_share, min_pixels},
                                         T.data(), found.data(), &degenerate);
        }
        return std::make_pair(steps, degenerate);
    });
    bind_images(m);
    nb::class_<Harmonics>(m, "Harmonics")
        .def(nb::init<Floats, Floats, Floats, Ints, int, int, float>(), nb::arg("params"), nb::arg("moment1"), nb::arg("moment2"),
             nb::arg("last_step"), nb::arg("degree"), nb::arg("step"), nb::arg("rate"));
    nb::class_<Rasteriser>(m, "Rasteriser")
        .def(nb::init<>())
        .def("blend_forward", &Rasteriser::blend_forward, nb::arg("means2d"), nb::arg("conics"), nb::arg("z"), nb::arg("radii"), nb::arg("opacities"),
             nb::arg("features"), nb::arg("width"), nb::arg("height"), nb::arg("alpha_min"), nb::arg("stop"), nb::arg("reference").none(), nb::arg("sums"),
             nb::arg("moment").none(), nb::arg("alpha"), nb::arg("median_id").none(), nb::arg("median_weight").none(), nb::arg("dominant_id").none(), nb::arg("dominant_weight").none())
        .def("blend_backward", &Rasteriser::blend_backward, nb::arg("g_sums"), nb::arg("g_moment").none(),
             nb::arg("g_alpha").none(), nb::arg("g_means2d"), nb::arg("g_conics"), nb::arg("g_z"), nb::arg("g_opacities"), nb::arg("g_features"))
        .def("gather", &Rasteriser::gather, nb::arg("planes"), nb::arg("sums"))
        .def("view_forward", &Rasteriser::view_forward, nb::arg("view"), nb::arg("params"), nb::arg("harmonics").none(), nb::arg("k"), nb::arg("alpha_min"), nb::arg("stop"), nb::arg("ray_depth"),
             nb::arg("reference").none(), nb::arg("sums"), nb::arg("moment").none(), nb::arg("alpha"), nb::arg("median_id").none(),
             nb::arg("median_weight").none(), nb::arg("dominant_id").none(), nb::arg("dominant_weight").none(), nb::arg("median_depth").none(), nb::arg("seconds"))
        .def("view_backward", &Rasteriser::view_backward, nb::arg("params"), nb::arg("g_sums"),
             nb::arg("g_moment").none(), nb::arg("g_alpha").none(), nb::arg("median_id").none(), nb::arg("g_median_depth").none(), nb::arg("g_params"),
             nb::arg("pull").none(), nb::arg("g_twist"), nb::arg("seconds"))
        .def("step", &Rasteriser::step, nb::arg("params"), nb::arg("moment1"), nb::arg("moment2"), nb::arg("last_step"), nb::arg("g_sums"), nb::arg("g_moment").none(), nb::arg("g_alpha").none(), nb::arg("median_id").none(), nb::arg("g_median_depth").none(), nb::arg("rates"),
             nb::arg("beta1"), nb::arg("beta2"), nb::arg("epsilon"), nb::arg("step"), nb::arg("isotropy"), nb::arg("frozen_colors"), nb::arg("harmonics").none(), nb::arg("pull").none(),
             nb::arg("g_twist"), nb::arg("seconds"))
        .def("backward_pose", &Rasteriser::backward_pose)
        .def("visible", &Rasteriser::visible);
}
