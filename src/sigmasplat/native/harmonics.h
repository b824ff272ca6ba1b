// Spherical harmonics of degrees 1 to 3 and their derivatives, templated on the number type (float, SIMD lanes). Has no
// includes and no namespace, like splat.h. data/harmonics.py is the definition.

template <class T> struct Dual { T value, by[3]; };   // a number and its derivatives with respect to x, y, z
template <class T> inline __attribute__((always_inline)) Dual<T> operator+(Dual<T> a, Dual<T> b) {
    return {a.value + b.value, {a.by[0] + b.by[0], a.by[1] + b.by[1], a.by[2] + b.by[2]}};
}
template <class T> inline __attribute__((always_inline)) Dual<T> operator-(Dual<T> a, Dual<T> b) {
    return {a.value - b.value, {a.by[0] - b.by[0], a.by[1] - b.by[1], a.by[2] - b.by[2]}};
}
template <class T> inline __attribute__((always_inline)) Dual<T> operator*(float a, Dual<T> b) {
    return {a * b.value, {a * b.by[0], a * b.by[1], a * b.by[2]}};
}
template <class T> inline __attribute__((always_inline)) Dual<T> operator*(Dual<T> a, Dual<T> b) {
    return {a.value * b.value, {a.by[0] * b.value + a.value * b.by[0], a.by[1] * b.value + a.value * b.by[1],
                                a.by[2] * b.value + a.value * b.by[2]}};
}

// Call take(number, value) for each harmonic of degrees 1 to `degree` in the direction (x, y, z), in order.
template <class Number, class Take>
inline __attribute__((always_inline)) void each_harmonic(Number x, Number y, Number z, int degree, Take take) {
    const float a1 = 0.4886025119029199f;                                  // √(3/4π)
    take(0, -a1 * y); take(1, a1 * z); take(2, -a1 * x);
    if (degree < 2) return;
    const float a2 = 1.0925484305920792f, b2 = 0.31539156525252005f;       // √(15/4π), √(5/16π)
    const Number xx = x * x, yy = y * y, zz = z * z, both = xx + yy, apart = xx - yy;
    take(3, a2 * (x * y)); take(4, -a2 * (y * z)); take(5, b2 * (2.f * zz - both)); take(6, -a2 * (x * z)); take(7, 0.5f * a2 * apart);
    if (degree < 3) return;
    const float a3 = 0.5900435899266435f, b3 = 1.445305721320277f,         // √(35/32π), √(210/32π)
        c3 = 0.4570457994644658f, d3 = 0.3731763325901154f;                // √(21/32π), √(14/32π)
    take(8, -a3 * (y * (3.f * xx - yy)));
    take(9, 2.f * b3 * (x * y * z));
    take(10, -c3 * (y * (4.f * zz - both)));
    take(11, d3 * (z * (2.f * zz - 3.f * both)));
    take(12, -c3 * (x * (4.f * zz - both)));
    take(13, b3 * (z * apart));
    take(14, -a3 * (x * (xx - 3.f * yy)));
}
