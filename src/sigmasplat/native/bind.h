// What the files of Python bindings share: arrays on the CPU, and the active instruction set.
#pragma once
#include <stdexcept>

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include "kernels.h"

namespace nb = nanobind;

using Floats = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using ConstFloats = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using Ints = nb::ndarray<int, nb::c_contig, nb::device::cpu>;
using ConstInts = nb::ndarray<const int, nb::c_contig, nb::device::cpu>;
using Bytes = nb::ndarray<uint8_t, nb::c_contig, nb::device::cpu>;
using Doubles = nb::ndarray<double, nb::c_contig, nb::device::cpu>;
using ConstDoubles = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;

namespace sigmasplat {
extern const Kernels* active;
void bind_images(nb::module_& m);
}  // namespace sigmasplat

static inline void need(bool ok, const char* what) { if (!ok) throw std::invalid_argument(what); }
