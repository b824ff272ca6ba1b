// Compares every lane operation of one instruction set with its definition on single numbers. Compiled once per
// instruction set, with SIGMASPLAT_ISA; prints the operations that differ and exits with 1, else prints "agree".
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <limits>
#include <set>
#include <string>

#include "lanes.h"

using namespace sigmasplat::SIGMASPLAT_ISA;
namespace lanes = sigmasplat::SIGMASPLAT_ISA;

static std::set<std::string> wrong;
static void expect(const char* operation, bool ok) { if (!ok) wrong.insert(operation); }

static uint32_t bits_of_one(float a) { uint32_t b; memcpy(&b, &a, 4); return b; }
static bool same(float a, float b) { return bits_of_one(a) == bits_of_one(b) || (std::isnan(a) && std::isnan(b)); }

// Numbers are read through this, so that the compiler cannot compute the operations itself.
template <class T> static T opaque(T a) { volatile T v = a; return v; }

constexpr float NAN_ = std::numeric_limits<float>::quiet_NaN(), INFINITE = std::numeric_limits<float>::infinity();
constexpr float SMALLEST = std::numeric_limits<float>::denorm_min();   // not flushed to 0
static const float NUMBERS[] = {0.f,     -0.f,    1.f,     -1.f,  0.5f,   -0.5f,  1.5f,   -1.5f,    2.5f,  -2.5f,        7.999999f,
                                -7.25f,  100.75f, -1e-20f, 1e-7f, 3e-39f, -3e-39f, SMALLEST, -SMALLEST, 65535.5f, 8388607.5f, -8388607.5f};
static const float SPECIAL[] = {NAN_, INFINITE, -INFINITE, 1e30f, -1e30f};
constexpr int COUNT = sizeof NUMBERS / sizeof *NUMBERS, SPECIALS = sizeof SPECIAL / sizeof *SPECIAL;

static uint32_t state = 12345;
static float drawn(float low, float high) {
    state = state * 1664525u + 1013904223u;
    return low + (high - low) * float(state >> 8) * (1.f / 16777216.f);
}

// Different numbers in the lanes, `first` in lane 0.
static vf some(float first, int offset) {
    alignas(64) float t[W];
    for (int l = 0; l < W; l++) t[l] = opaque(l == 0 ? first : NUMBERS[(offset + 5 * l) % COUNT]);
    return load(t);
}

template <class Lanes, class One> static void each_pair(const char* name, Lanes lanes_do, One one_does) {
    for (int i = 0; i < COUNT + SPECIALS; i++)
        for (int j = 0; j < COUNT + SPECIALS; j++) {
            const vf a = some(i < COUNT ? NUMBERS[i] : SPECIAL[i - COUNT], i), b = some(j < COUNT ? NUMBERS[j] : SPECIAL[j - COUNT], 3 * j + 1);
            const vf r = lanes_do(a, b);
            for (int l = 0; l < W; l++) expect(name, same(r[l], one_does(a[l], b[l])));
        }
}

static void check_numbers() {
    each_pair("min", [](vf a, vf b) { return lanes::min(a, b); }, [](float a, float b) { return a < b ? a : b; });
    each_pair("max", [](vf a, vf b) { return lanes::max(a, b); }, [](float a, float b) { return a > b ? a : b; });
    each_pair("abs", [](vf a, vf) { return lanes::abs(a); }, [](float a, float) { return a > -a ? a : -a; });
    each_pair("sum", [](vf a, vf b) { return a + b; }, [](float a, float b) { return opaque(a) + b; });
    each_pair("product", [](vf a, vf b) { return a * b; }, [](float a, float b) { return opaque(a) * b; });
    each_pair("quotient", [](vf a, vf b) { return a / b; }, [](float a, float b) { return opaque(a) / b; });
    each_pair("select by gt", [](vf a, vf b) { return select(gt(a, b), a, splat(7.f)); }, [](float a, float b) { return a > b ? a : 7.f; });
    each_pair("select by ge", [](vf a, vf b) { return select(ge(a, b), a, splat(7.f)); }, [](float a, float b) { return a >= b ? a : 7.f; });
    each_pair("only", [](vf a, vf b) { return only(gt(b, splat(0.f)), a); }, [](float a, float b) { return b > 0.f ? a : 0.f; });
    each_pair("both", [](vf a, vf b) { return only(both(gt(a, splat(0.f)), gt(b, splat(0.f))), splat(1.f)); },
              [](float a, float b) { return float(a > 0.f && b > 0.f); });
    each_pair("mask_or", [](vf a, vf b) { return only(mask_or(gt(a, splat(0.f)), gt(b, splat(0.f))), splat(1.f)); },
              [](float a, float b) { return float(a > 0.f || b > 0.f); });
    each_pair("mask_not", [](vf a, vf b) { return only(mask_not(gt(a, b)), splat(1.f)); }, [](float a, float b) { return float(!(a > b)); });
    each_pair("sqrt", [](vf a, vf) { return lanes::sqrt(select(ge(a, splat(0.f)), a, splat(0.f))); },
              [](float a, float) { return std::sqrt(a >= 0.f ? a : 0.f); });
    each_pair("clamp", [](vf a, vf) { return lanes::clamp(a, -2.f, 3.f); },
              [](float a, float) { const float b = a > -2.f ? a : -2.f; return b < 3.f ? b : 3.f; });
    for (int i = 0; i < COUNT; i++) {                 // special numbers have no integer
        const vf a = some(NUMBERS[i], i), whole = lanes::floor(a), back = to_float(to_int(a));
        for (int l = 0; l < W; l++) {
            expect("floor", whole[l] == std::floor(a[l]));
            expect("to_int", back[l] == std::trunc(a[l]));
        }
    }
    for (int i = 0; i < 2000; i++) {
        const vf a = some(drawn(-3.f, 3.f), i), b = some(drawn(-3.f, 3.f), i + 1), c = some(drawn(-3.f, 3.f), i + 2);
        for (int l = 0; l < W; l++) {
            const double exact = double(a[l]) * b[l] + c[l], exact_n = double(c[l]) - double(a[l]) * b[l];
            const double slack = 1.3e-7 * (std::fabs(double(a[l]) * b[l]) + std::fabs(double(c[l]))) + 1e-44;   // fused or not
            expect("fma", std::fabs(lanes::fma(a, b, c)[l] - exact) <= slack);
            expect("fnma", std::fabs(fnma(a, b, c)[l] - exact_n) <= slack);
        }
    }
}

static void check_functions() {
    for (int i = 0; i < 20000; i++) {
        const float x = drawn(-125.f, 126.f), t = drawn(-8.f, 0.f), y = std::exp2(drawn(-120.f, 120.f));
        const vf power = lanes::exp2(splat(opaque(x))), alpha = exp2_alpha(splat(opaque(t))), logarithm = lanes::log2(splat(opaque(y)));
        const double want = std::exp2(double(x)), want_alpha = std::exp2(double(t)), want_log = std::log2(double(y));
        for (int l = 0; l < W; l++) {
            expect("exp2", std::fabs(power[l] - want) <= 2.5e-7 * want);
            expect("exp2_alpha", std::fabs(alpha[l] - want_alpha) <= 3.5e-7 * want_alpha);
            expect("log2", std::fabs(logarithm[l] - want_log) <= 2e-7 * (1.0 + std::fabs(want_log)));
        }
    }
    const float ends[] = {-INFINITE, -1e30f, -126.f, 127.f, 1e30f, INFINITE};
    for (float x : ends) expect("exp2 at the ends", lanes::exp2(splat(opaque(x)))[W - 1] == std::exp2(std::min(std::max(x, -126.f), 127.f)));
}

static void check_masks() {
    const unsigned all = (1u << W) - 1u;
    for (unsigned b = 0; b <= all; b += W < 16 ? 1 : 37) {
        const Mask m = mask_of_bits(opaque(b));
        expect("bits of mask_of_bits", (bits(m) & all) == b);
        expect("any", any(m) == (b != 0));
        const vf shown = only(m, splat(1.f));
        const vi chosen = select(m, splat(3), splat(-4));
        for (int l = 0; l < W; l++) {
            expect("mask_of_bits", shown[l] == float((b >> l) & 1));
            expect("select of integers", chosen[l] == ((b >> l) & 1 ? 3 : -4));
        }
    }
    for (int n = -1; n <= 40; n++) expect("first_lanes", (bits(first_lanes(opaque(n))) & all) == (n <= 0 ? 0u : n >= W ? all : (1u << n) - 1u));
}

template <int N> static void check_first(const float* from) {
    const vf r = load_first<N>(from);
    float to[W + 1];
    for (float& t : to) t = -5.f;
    store_first<N>(to, load(from));
    for (int l = 0; l < W; l++) {
        expect("load_first", r[l] == (l < N ? from[l] : 0.f));
        expect("store_first", to[l] == (l < N ? from[l] : -5.f));
    }
}

static void check_movements() {
    alignas(64) float numbers[W * W + W + 64];
    for (size_t i = 0; i < sizeof numbers / sizeof *numbers; i++) numbers[i] = opaque(float(i) + 0.25f);
    for (int shift = 0; shift < 4; shift++) {         // addresses that are not those of whole vectors
        const vf a = load(numbers + shift);
        float to[W + 4];
        store(to + shift, a);
        for (int l = 0; l < W; l++) expect("load and store", a[l] == numbers[shift + l] && to[shift + l] == numbers[shift + l]);
    }
    check_first<1>(numbers + 1);
    check_first<3>(numbers + 1);
    check_first<W - 1>(numbers + 1);
    check_first<W>(numbers + 1);
    vf rows[W];
    for (int i = 0; i < W; i++) rows[i] = load(numbers + i * W);
    transpose(rows);
    for (int i = 0; i < W; i++)
        for (int l = 0; l < W; l++) expect("transpose", rows[i][l] == numbers[l * W + i]);
    vi places;
    for (int l = 0; l < W; l++) places[l] = opaque((7 * l + 3) % (W * W));
    const vf found = gather(numbers, places);
    for (int l = 0; l < W; l++) expect("gather", found[l] == numbers[places[l]]);
    const size_t stride = 11;
    vi from;
    for (int l = 0; l < W; l++) from[l] = (7 * l + 3) % (W * W - 4);
    vf fours[4];
    gather_fours(numbers, from, fours);
    for (int k = 0; k < 4; k++)
        for (int l = 0; l < W; l++) expect("gather_fours", fours[k][l] == numbers[from[l] + k]);
    const vf block = load_block(numbers + 1, stride);
    for (int l = 0; l < W; l++) expect("load_block", block[l] == numbers[1 + l / BLOCK_WIDTH * stride + l % BLOCK_WIDTH]);
    float image[64] = {};
    int labels[64] = {};
    store_block(image + 1, stride, block);
    store_block(labels + 1, stride, to_int(block));
    for (int l = 0; l < W; l++) {
        const size_t at = 1 + l / BLOCK_WIDTH * stride + l % BLOCK_WIDTH;
        expect("store_block", image[at] == block[l] && labels[at] == int(block[l]));
    }
    alignas(64) float streamed[W];
    stream(streamed, block);
    fence();
    float sum = 0;
    for (int l = 0; l < W; l++) { expect("stream", streamed[l] == block[l]); sum += block[l]; }
    expect("lane_sum", lane_sum(block) == sum);
    for (int l = 0; l < W; l++) expect("lane_index", lane_index()[l] == float(l) && splat(opaque(-0.f))[l] == 0.f);
}

int main() {
    check_numbers();
    check_functions();
    check_masks();
    check_movements();
    for (const auto& operation : wrong) std::printf("differs: %s\n", operation.c_str());
    if (wrong.empty()) std::printf("agree\n");
    return wrong.empty() ? 0 : 1;
}
