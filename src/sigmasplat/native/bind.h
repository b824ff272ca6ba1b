// What the files of Python bindings share: arrays on the CPU, and the active instruction set.
#pragma once
#include <cstring>
#include <optional>
#include <stdexcept>
#include <vector>

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include "kernels.h"

namespace nb = nanobind;

using Floats = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using ConstFloats = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using Ints = nb::ndarray<int, nb::c_contig, nb::device::cpu>;
using ConstInts = nb::ndarray<const int, nb::c_contig, nb::device::cpu>;
using Bytes = nb::ndarray<uint8_t, nb::c_contig, nb::device::cpu>;
template <class T> using Maybe = std::optional<T>;
using Doubles = nb::ndarray<double, nb::c_contig, nb::device::cpu>;
using ConstDoubles = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;

namespace sigmasplat {
extern const Kernels* active;
void bind_images(nb::module_& m);
}  // namespace sigmasplat

static inline void need(bool ok, const char* what) { if (!ok) throw std::invalid_argument(what); }

// The readouts of two images from the numbers of `data.readout.readouts`; nothing if there are none.
static inline std::optional<sigmasplat::AlignReadouts> readouts_of(const std::vector<float>& numbers) {
    std::optional<sigmasplat::AlignReadouts> found;
    need(numbers.empty() || numbers.size() == sizeof(sigmasplat::AlignReadouts) / sizeof(float), "two readouts have 18 numbers");
    if (!numbers.empty()) std::memcpy(&found.emplace(), numbers.data(), sizeof(sigmasplat::AlignReadouts));
    return found;
}
