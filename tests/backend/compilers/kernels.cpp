// Runs every kernel of every instruction set on drawn scenes. Three comparisons, each with its tolerance below:
// one thread with three (same bytes), each instruction set with `portable` (lanes without SIMD), and with --compare FILE
// each with the numbers that another build has stored with --write FILE. Prints what differs and exits with 1.
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <map>
#include <string>
#include <vector>

#include <omp.h>

#include "kernels.h"

using namespace sigmasplat;
namespace sigmasplat {
namespace portable { extern const Kernels table; }
namespace baseline { extern const Kernels table; }
#if defined(__x86_64__)
namespace avx2 { extern const Kernels table; }
namespace avx512 { extern const Kernels table; }
#endif
}  // namespace sigmasplat

// ‖a − b‖ ≤ TOLERANCE · ‖b‖ for each array: float32 with and without fused multiply-adds. Numbers of splats may differ
// at pixels where two weights are equal but for rounding.
constexpr double TOLERANCE = 1e-4, UNEQUAL_IDS = 2e-3;

using Numbers = std::vector<float>;
using Results = std::map<std::string, Numbers>;

struct Draw {
    uint32_t state;
    float operator()(float low, float high) {
        state = state * 1664525u + 1013904223u;
        return low + (high - low) * float(state >> 8) * (1.f / 16777216.f);
    }
    Numbers many(size_t n, float low, float high) { Numbers r(n); for (float& x : r) x = (*this)(low, high); return r; }
};

constexpr int N = 611, ROW = 17, HARMONICS = 45, WIDTH = 70, HEIGHT = 50;   // neither is a multiple of any vector or tile
constexpr int STRIDE = 80, ROWS = 64;                                        // whole tiles of 16×16
constexpr size_t PLANE = size_t(STRIDE) * ROWS;

// Zero outside the image, where planes depend on the shape of a vector's block of pixels.
static Numbers in_image(Numbers planes) {
    for (size_t i = 0; i < planes.size(); i++)
        if (int(i % STRIDE) >= WIDTH || int(i % PLANE / STRIDE) >= HEIGHT) planes[i] = 0.f;
    return planes;
}

static Numbers view_numbers() {            // struct View of splat.h
    const float c = 0.9987503f, s = 0.0499792f;                              // turned about y by 0.05
    return {60, 62, 34.5f, 24.5f, c, 0, s, 0, 1, 0, -s, 0, c, 0.02f, -0.03f, 0.1f, 0.2f, 0.3f,
            -0.75f, 0.75f, -0.55f, 0.55f, WIDTH, HEIGHT, 1, 1, 1};
}

static Numbers splat_rows() {              // columns of GaussianField; some splats are behind the camera or off the image
    Draw draw{7};
    Numbers rows;
    for (int i = 0; i < N; i++) {
        const float z = draw(i % 17 ? 0.8f : -1.f, 4.f);
        for (float x : {z * draw(-0.8f, 0.8f), z * draw(-0.6f, 0.6f), z}) rows.push_back(x);
        for (int k = 0; k < 4; k++) rows.push_back(draw(-1.f, 1.f) + (k == 0));
        for (int k = 0; k < 3; k++) rows.push_back(draw(-4.5f, -1.8f));
        rows.push_back(draw(-3.f, 4.f));
        for (int k = 0; k < 3; k++) rows.push_back(draw(0.f, 1.f));
        for (int k = 0; k < 3; k++) rows.push_back(draw(-7.f, -3.f));
    }
    return rows;
}

static Numbers column(const Numbers& rows, int first, int count, float (*activate)(float)) {
    Numbers r;
    for (int i = 0; i < N; i++)
        for (int k = 0; k < count; k++) r.push_back(activate(rows[size_t(i) * ROW + first + k]));
    return r;
}
static float as_it_is(float x) { return x; }
static float exponential(float x) { return std::exp(x); }
static float logistic(float x) { return 1.f / (1.f + std::exp(-x)); }

static Numbers floats_of(const double* from, size_t n) { return Numbers(from, from + n); }
static Numbers floats_of(const std::vector<int>& from) { return Numbers(from.begin(), from.end()); }

struct Maps {                              // the images of a forward pass
    Numbers sums, moment = Numbers(PLANE), alpha = Numbers(PLANE), median_weight = Numbers(PLANE), dominant_weight = Numbers(PLANE),
            median_depth = Numbers(PLANE);
    std::vector<int> median_id = std::vector<int>(PLANE), dominant_id = std::vector<int>(PLANE);
    explicit Maps(int k) : sums(k * PLANE) {}
    Outputs outputs(bool depth) {
        return {sums.data(), moment.data(), alpha.data(), median_id.data(), median_weight.data(), dominant_id.data(),
                dominant_weight.data(), depth ? median_depth.data() : nullptr};
    }
    void add_to(Results& out, const std::string& name, bool depth) const {
        out[name + " sums"] = in_image(sums);
        out[name + " moment"] = in_image(moment);
        out[name + " alpha"] = in_image(alpha);
        out[name + " median weight"] = in_image(median_weight);
        out[name + " dominant weight"] = in_image(dominant_weight);
        if (depth) out[name + " median depth"] = in_image(median_depth);
        out[name + " median ids"] = in_image(floats_of(median_id));
        out[name + " dominant ids"] = in_image(floats_of(dominant_id));
    }
};

static void run_operators(const Kernels& k, Results& out) {
    const Numbers view = view_numbers(), rows = splat_rows();
    const Numbers means = column(rows, 0, 3, as_it_is), quats = column(rows, 3, 4, as_it_is), scales = column(rows, 7, 3, exponential),
                  opacities = column(rows, 10, 1, logistic);
    Numbers means2d(2 * N), conics(3 * N), z(N), radii(2 * N);
    k.project_forward(view.data(), means.data(), quats.data(), scales.data(), N, means2d.data(), conics.data(), z.data(), radii.data(), nullptr);
    out["project means"] = means2d;
    out["project conics"] = conics;
    out["project z"] = z;
    out["project radii"] = radii;
    for (int features : {3, 7, 10}) {
        const std::string name = "blend " + std::to_string(features);
        Draw draw{uint32_t(features)};
        const Numbers colors = draw.many(size_t(N) * features, 0.f, 1.f), reference = draw.many(PLANE, 0.5f, 4.f);
        Context* context = k.create();
        const int slots = features <= 4 ? 4 : features <= 7 ? 7 : 11;
        Maps maps(slots);
        k.blend_forward(context, means2d.data(), conics.data(), z.data(), radii.data(), opacities.data(), colors.data(), N, features, WIDTH,
                        HEIGHT, reference.data(), {1.f / 255.f, 1e-4f}, maps.outputs(false));
        maps.add_to(out, name, false);
        const Numbers g_sums = in_image(draw.many(slots * PLANE, -1.f, 1.f)), g_moment = in_image(draw.many(PLANE, -1.f, 1.f)),
                      g_alpha = in_image(draw.many(PLANE, -1.f, 1.f));
        Numbers g_means2d(2 * N), g_conics(3 * N), g_z(N), g_opacities(N), g_features(size_t(N) * features);
        k.blend_backward(context, {g_sums.data(), g_moment.data(), g_alpha.data()},
                         {g_means2d.data(), g_conics.data(), g_z.data(), g_opacities.data(), g_features.data()});
        out[name + " g means"] = g_means2d;
        out[name + " g conics"] = g_conics;
        out[name + " g z"] = g_z;
        out[name + " g opacities"] = g_opacities;
        out[name + " g features"] = g_features;
        k.destroy(context);
        if (features != 3) continue;
        Numbers g_means(3 * N), g_quats(4 * N), g_scales(3 * N);
        double twist[6];
        k.project_backward(view.data(), means.data(), quats.data(), scales.data(), N, radii.data(), g_means2d.data(), g_conics.data(), g_z.data(),
                           g_means.data(), g_quats.data(), g_scales.data(), twist);
        out["project g means"] = g_means;
        out["project g quats"] = g_quats;
        out["project g scales"] = g_scales;
        out["project twist"] = floats_of(twist, 6);
    }
}

struct Fit {                               // rows, their harmonics, and Adam's state of both
    Numbers params = splat_rows(), moment1, moment2, harmonics, harmonics1, harmonics2;
    std::vector<int> last, harmonics_last;
    Fit() {
        Draw draw{21};
        moment1 = draw.many(params.size(), -1e-2f, 1e-2f);
        moment2 = draw.many(params.size(), 1e-4f, 1e-3f);
        harmonics = draw.many(size_t(N) * HARMONICS, -0.2f, 0.2f);
        harmonics1 = draw.many(harmonics.size(), -1e-2f, 1e-2f);
        harmonics2 = draw.many(harmonics.size(), 1e-4f, 1e-3f);
        for (int i = 0; i < N; i++) last.push_back(i < 64 ? 4 : i % 5);      // some rows have missed steps
        harmonics_last = last;
    }
};

static void run_view(const Kernels& k, int features, BlendOptions options, int degree, const std::string& name, Results& out) {
    const Numbers view = view_numbers();
    Fit fit;
    Draw draw{uint32_t(features + degree)};
    const Numbers reference = draw.many(PLANE, 0.5f, 4.f), g_sums = in_image(draw.many(features * PLANE, -1.f, 1.f)),
                  g_moment = in_image(draw.many(PLANE, -1.f, 1.f)), g_alpha = in_image(draw.many(PLANE, -1.f, 1.f)),
                  g_median = in_image(draw.many(PLANE, -1.f, 1.f));
    double seconds[3] = {}, twist[6];
    Context* context = k.create();
    Maps maps(features);
    k.view_forward(context, view.data(), fit.params.data(), {fit.harmonics.data(), degree}, N, features, reference.data(), options,
                   maps.outputs(true), seconds);
    maps.add_to(out, name, true);
    std::vector<uint8_t> visible(N);
    k.view_visible(context, visible.data());
    out[name + " visible"] = Numbers(visible.begin(), visible.end());
    const OutputGradients g{g_sums.data(), g_moment.data(), g_alpha.data(), maps.median_id.data(), g_median.data()};
    Numbers g_params(fit.params.size()), pull(N);
    k.view_backward_pose(context, fit.params.data(), {g_sums.data(), nullptr, nullptr}, twist, seconds);
    out[name + " pose twist"] = floats_of(twist, 6);
    k.view_backward(context, fit.params.data(), g, g_params.data(), pull.data(), twist, seconds);
    out[name + " g rows"] = g_params;
    out[name + " pull"] = pull;
    out[name + " twist"] = floats_of(twist, 6);
    const Numbers rates = Draw{3}.many(ROW, 1e-3f, 1e-2f);
    const AdamOptions adam{rates.data(), 0.9f, 0.999f, 1e-3f, 5};
    const HarmonicsStep harmonics{fit.harmonics.data(), {fit.harmonics1.data(), fit.harmonics2.data(), fit.harmonics_last.data()}, degree, 5, 1e-3f};
    const double cost = k.view_step(context, fit.params.data(), g, {fit.moment1.data(), fit.moment2.data(), fit.last.data()}, adam,
                                    {0.1f, 0.2f, 9}, degree ? harmonics : HarmonicsStep{}, pull.data(), twist, seconds);
    out[name + " step cost and twist"] = floats_of(twist, 6);
    out[name + " step cost and twist"].push_back(float(cost));
    k.adam_settle(fit.params.data(), N, {fit.moment1.data(), fit.moment2.data(), fit.last.data()}, {rates.data(), 0.9f, 0.999f, 1e-3f, 7});
    const Numbers before = splat_rows(), harmonics_before = Fit().harmonics;
    for (size_t i = 0; i < before.size(); i++) fit.params[i] -= before[i];
    for (size_t i = 0; i < harmonics_before.size(); i++) fit.harmonics[i] -= harmonics_before[i];
    out[name + " step"] = fit.params;
    out[name + " moments"] = fit.moment1;
    out[name + " squares"] = fit.moment2;
    if (degree) out[name + " harmonics step"] = fit.harmonics;
    k.destroy(context);
}

static void run_losses(const Kernels& k, Results& out) {
    Draw draw{31};
    Numbers sums = draw.many(7 * PLANE, 0.05f, 1.f), target = draw.many(3 * PLANE, 0.f, 1.f), depth = draw.many(PLANE, 0.5f, 4.f),
            alpha = draw.many(PLANE, 0.2f, 1.f), moment = draw.many(PLANE, 0.f, 0.1f), median = draw.many(PLANE, 0.5f, 4.f), mask(PLANE);
    for (size_t i = 0; i < PLANE; i++) {
        const int x = int(i % STRIDE), y = int(i / STRIDE);
        const bool inside = x < WIDTH && y < HEIGHT;
        if (!inside || draw(0.f, 1.f) < 0.2f) depth[i] = 0.f;
        for (int c = 0; c < 3; c++) sums[(4 + c) * PLANE + i] = sums[c * PLANE + i] * sums[c * PLANE + i] + (draw(0.f, 1.f) < 0.05f ? -0.01f : draw(0.02f, 0.2f));
        mask[i] = depth[i] > 0.f;
    }
    const size_t wide = (WIDTH + k.pad.lanes - 1) / k.pad.lanes * size_t(k.pad.lanes);
    for (const float* where : {static_cast<const float*>(nullptr), static_cast<const float*>(mask.data())}) {
        Numbers cache(6 * wide * HEIGHT), gradient(3 * PLANE);
        k.ssim_target(target.data(), where, WIDTH, HEIGHT, STRIDE, PLANE, cache.data());
        const double value = k.ssim(sums.data(), target.data(), cache.data(), WIDTH, HEIGHT, STRIDE, PLANE, where, 100.f, gradient.data());
        const std::string name = where ? "ssim masked" : "ssim";
        out[name] = {float(value)};
        out[name + " g"] = gradient;
    }
    for (bool variance : {false, true}) {
        const std::string name = variance ? " with variance" : "";
        Numbers g_sums((variance ? 7 : 4) * PLANE), g_median(PLANE), g_moment(PLANE), g_alpha(PLANE), g_track((variance ? 7 : 4) * PLANE);
        double losses[LOSS_TERMS], exposure[2];
        k.mapping_losses(sums.data(), target.data(), depth.data(), HEIGHT, STRIDE, PLANE, variance, {median.data(), moment.data(), alpha.data()},
                         {0.8f, 1.f, 0.1f, 0.1f, 0.3f, 0.2f, 0.5f}, 2000., g_sums.data(), {g_median.data(), g_moment.data(), g_alpha.data()}, losses);
        out["mapping losses" + name] = floats_of(losses, LOSS_TERMS);
        out["mapping g sums" + name] = g_sums;
        out["mapping g median" + name] = g_median;
        out["mapping g moment" + name] = g_moment;
        out["mapping g alpha" + name] = g_alpha;
        const TrackOptions options{0.5f, 2.f, 10.f, 5.f, 0.6f, 0.5f, 10.f, variance, true};
        const double loss = k.tracking_loss(sums.data(), alpha.data(), variance, target.data(), depth.data(), {WIDTH, HEIGHT, STRIDE, PLANE}, options,
                                            1.1f, 0.02f, g_track.data(), exposure);
        out["tracking loss" + name] = {float(loss), float(exposure[0]), float(exposure[1])};
        out["tracking g sums" + name] = g_track;
        Numbers gray(WIDTH * HEIGHT), z(gray), weight_gray(gray), weight_depth(gray);
        k.reference_maps(sums.data(), alpha.data(), moment.data(), variance, {WIDTH, HEIGHT, STRIDE, PLANE}, options, gray.data(), z.data(),
                         weight_gray.data(), weight_depth.data());
        out["reference gray" + name] = gray;
        out["reference depth" + name] = z;
        out["reference weight of gray" + name] = weight_gray;
        out["reference weight of depth" + name] = weight_depth;
    }
}

static void run_alignment(const Kernels& k, Results& out) {
    Draw draw{41};
    Numbers gray[2], depth[2];
    for (int q = 0; q < 2; q++)
        for (int y = 0; y < HEIGHT; y++)
            for (int x = 0; x < WIDTH; x++) {         // the second image is moved by (0.6, −0.3) pixels
                const double u = x - 0.6 * q, v = y + 0.3 * q;
                gray[q].push_back(float(0.5 + 0.2 * std::sin(0.31 * u) + 0.2 * std::cos(0.23 * v + 0.1 * u)));
                depth[q].push_back(draw(0.f, 1.f) < 0.05f ? 0.f : float(2.0 + 0.3 * std::sin(0.11 * u + 0.07 * v)));
            }
    const Numbers weight = draw.many(WIDTH * HEIGHT, 0.5f, 2.f);
    const AlignLevel level{{gray[0].data(), depth[0].data(), weight.data(), weight.data(), gray[1].data(), depth[1].data()},
                           {WIDTH, HEIGHT, 60.f, 60.f, 34.5f, 24.5f}};
    const AlignOptions options{1.f, 0.5f, 0.05f, 0.02f, 0.3f, 1.f};
    // Not the identity, which puts pixels on pixels: there rounding decides about the derivative.
    double T[12] = {1, 0, 0, 0.013, 0, 1, 0, -0.007, 0, 0, 1, 0.004}, normal[55], found[6];
    const AlignReadouts late{{{0.1f, -0.2f, 0.05f, 0.3f, 0.1f, -0.2f}, 0.02f, 0.03f, 0.03f}, {{-0.1f, 0.1f, 0.1f, 0.2f, 0.2f, 0.1f}, 0.02f, 0.03f, 0.03f}};
    for (const AlignReadouts* times : {static_cast<const AlignReadouts*>(nullptr), &late}) {
        k.align_steps(&level, &options, times, 1, 1, T, normal);
        out[times ? "align, late rows" : "align"] = floats_of(normal, 55);
    }
    int degenerate;
    const int steps = k.align_images(&level, &options, nullptr, 1, {60, 1e-7, 0.0, 2.0, 1e-6, 50.0}, T, found, &degenerate);
    out["align T"] = floats_of(T, 12);
    if (steps < 1 || T[3] == 0.013 || degenerate) out["align T"][0] = NAN;      // nothing was aligned
}

static Results run(const Kernels& k, int threads) {
    omp_set_num_threads(threads);
    Results out;
    run_operators(k, out);
    run_view(k, 4, {1.f / 255.f, 1e-4f}, 0, "view", out);
    run_view(k, 7, {1.f / 255.f, 1e-4f}, 2, "view of degree 2", out);
    run_view(k, 7, {1.f / 255.f, 1e-4f, true}, 3, "view along rays", out);
    run_losses(k, out);
    run_alignment(k, out);
    return out;
}

// The relative difference of two arrays: of norms, or for numbers of splats the share of different ones. Arrays that
// are all zero, or hold a NaN, agree with nothing.
static double difference(const std::string& name, const Numbers& a, const Numbers& b) {
    if (a.size() != b.size()) return INFINITY;
    double off = 0, norm = 0, unequal = 0;
    for (size_t i = 0; i < a.size(); i++) {
        off += (double(a[i]) - b[i]) * (double(a[i]) - b[i]);
        norm += double(b[i]) * b[i];
        unequal += a[i] != b[i];
    }
    if (!(norm > 0) || !std::isfinite(off)) return INFINITY;
    const bool ids = name.ends_with(" ids") || name.ends_with(" visible");
    return ids ? unequal / double(a.size()) * (TOLERANCE / UNEQUAL_IDS) : std::sqrt(off / norm);
}

static bool agree(const char* isa, const char* with, const Results& a, const Results& b) {
    double worst = 0;
    std::string where;
    bool ok = a.size() == b.size();
    if (!ok) std::printf("%s: other arrays than %s\n", isa, with);
    for (const auto& [name, numbers] : b) {
        const auto found = a.find(name);
        const double d = found == a.end() ? INFINITY : difference(name, found->second, numbers);
        if (!(d <= TOLERANCE)) {
            std::printf("%s differs from %s: %s, %.1e\n", isa, with, name.c_str(), d);
            ok = false;
        }
        if (d >= worst) { worst = d; where = name; }
    }
    if (ok) std::printf("%s agrees with %s: %zu arrays, largest difference %.1e (%s)\n", isa, with, b.size(), worst, where.c_str());
    return ok;
}

static bool same_bytes(const char* isa, const Results& a, const Results& b) {
    bool ok = true;
    for (const auto& [name, numbers] : a)
        if (memcmp(numbers.data(), b.at(name).data(), numbers.size() * sizeof(float))) {
            std::printf("%s depends on the number of threads: %s\n", isa, name.c_str());
            ok = false;
        }
    return ok;
}

static void write(const Results& results, const char* path) {
    FILE* file = std::fopen(path, "wb");
    for (const auto& [name, numbers] : results) {
        std::fprintf(file, "%s\n%zu\n", name.c_str(), numbers.size());
        std::fwrite(numbers.data(), sizeof(float), numbers.size(), file);
    }
    std::fclose(file);
}

static Results read(const char* path) {
    Results results;
    FILE* file = std::fopen(path, "rb");
    char name[200];
    size_t count;
    while (file && std::fscanf(file, "%199[^\n]\n%zu", name, &count) == 2 && std::fgetc(file) == '\n') {
        Numbers numbers(count);
        if (std::fread(numbers.data(), sizeof(float), count, file) != count) break;
        results[name] = numbers;
    }
    if (file) std::fclose(file);
    return results;
}

#ifdef SIGMASPLAT_TWO_THREADS
// Two threads run the kernels at the same time, as tracking and mapping do, each on one core. ThreadSanitizer reports
// memory that both use (.ci/threads). These calls replace OpenMP's, whose runtime it cannot follow.
#include <thread>
extern "C" {
int omp_get_max_threads() { return 1; }
int omp_get_num_threads() { return 1; }
int omp_get_thread_num() { return 0; }
void omp_set_num_threads(int) {}
double omp_get_wtime() { return 0; }
}

int main() {
    const Results alone = run(portable::table, 1);
    Results tracking, mapping;
    std::thread other([&] { mapping = run(portable::table, 1); });
    tracking = run(portable::table, 1);
    other.join();
    const bool ok = same_bytes("portable", alone, tracking) && same_bytes("portable", alone, mapping);
    std::printf("two threads: %zu arrays%s\n", alone.size(), ok ? " are the same" : "");
    return ok ? 0 : 1;
}
#else
int main(int argc, char** argv) {
    std::vector<const Kernels*> tables = {&portable::table, &baseline::table};
#if defined(__x86_64__)
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) tables.push_back(&avx2::table);
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512dq"))
        tables.push_back(&avx512::table);
#endif
    const std::string option = argc == 3 ? argv[1] : "";
    const Results portable_results = run(portable::table, 1);
    bool ok = true;
    for (const Kernels* k : tables) {
        const Results results = run(*k, 1);
        ok &= same_bytes(k->name, results, run(*k, 3));
        ok &= agree(k->name, "portable", results, portable_results);
        if (option == "--compare") ok &= agree(k->name, "the stored numbers", results, read(argv[2]));
    }
    if (option == "--write") write(portable_results, argv[2]);
    return ok ? 0 : 1;
}
#endif
