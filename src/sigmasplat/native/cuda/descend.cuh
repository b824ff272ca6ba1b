// Minimise the tracking loss by Adam on the device: the work of fit/descent.py between a gradient and the next render.
// Included by track.cuh.
#pragma once

namespace sigmasplat {

struct Pairs { const long long* total; long long room; };   // pairs of tiles and splats: number needed, number that fits

// If there are more pairs than fit, set every splat's count to 0, so that the backward pass reads no unwritten record.
KERNEL drop_pairs(Pairs pairs, int n, int* counts) {
    const int i = thread_number();
    if (i < n && *pairs.total > pairs.room) counts[i] = 0;
}

struct Descending {                        // layout: plugins/cuda/descent.py
    double numbers[7], moment1[9], moment2[9];        // pose parameters, rotation first; Adam's moments, exposure's last
    double largest[9], amsgrad;                       // second moments so far; 1: AMSGrad, 0: Adam
    double exposure[2], best_exposure[2];             // (a, b)
    double T[12], best_T[12];                         // T_camera_world, rows of [R | t]: now, and at the smallest loss
    double first, best, lowered;                      // losses; lowered: when it last fell by the share of a plateau
    long long waited, steps, stopped, missing;        // waited: steps since then; missing: pairs needed if not all fit
};
struct DescentNumbers {                    // guess: rows of T_camera_world
    double guess[12], beta1, beta2, epsilon, lr_rotation, lr_translation, lr_exposure, update_stop, plateau_stop, plateau_window;
};
struct Shown { float pose[16], gain, offset; };       // the pose and exposure that render and loss use

// Sum what the blocks of a kernel stored, COUNT numbers each, in a fixed order. All threads must call this; thread 0
// gets the sums.
template <int COUNT> inline void sum_blocks(const double* partial, int blocks, double* total) {
    __shared__ double of_warps[COUNT * THREADS / 32];
    const int t = int(threadIdx.x);
    for (int q = 0; q < COUNT; q++) {
        double sum = 0.0;
        for (int b = t; b < blocks; b += THREADS) sum += partial[size_t(b) * COUNT + q];
        for (int apart = 16; apart > 0; apart /= 2) sum += __shfl_xor_sync(ALL_LANES, sum, apart);
        if (t % 32 == 0) of_warps[q * (THREADS / 32) + t / 32] = sum;
    }
    __syncthreads();
    for (int q = 0; q < COUNT; q++) {
        total[q] = 0.0;
        for (int w = 0; w < THREADS / 32; w++) total[q] += of_warps[q * (THREADS / 32) + w];
    }
}

inline void cross_product(const double* a, const double* b, double* out) {
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}
inline void times(const double* R, const double* v, double* out) {
    for (int i = 0; i < 3; i++) out[i] = R[3 * i] * v[0] + R[3 * i + 1] * v[1] + R[3 * i + 2] * v[2];
}

// Compute the rotation exp([w]×) and its left Jacobian, by rows (data/se3.py: exp).
inline void rotation_of_axis(const double* w, double* R, double* jacobian) {
    const double theta2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2], theta = sqrt(theta2);
    const bool small = theta2 < 1e-8;
    const double a = small ? 1.0 - theta2 / 6.0 : sin(theta) / theta;
    const double b = small ? 0.5 - theta2 / 24.0 : (1.0 - cos(theta)) / theta2;
    const double c = small ? 1.0 / 6.0 - theta2 / 120.0 : (theta - sin(theta)) / (theta2 * theta);
    const double k[9] = {0.0, -w[2], w[1], w[2], 0.0, -w[0], -w[1], w[0], 0.0};
    for (int i = 0; i < 9; i++) {
        const int row = i / 3, column = i % 3;
        const double one = row == column, kk = w[row] * w[column] - one * theta2;
        R[i] = one + a * k[i] + b * kk;
        jacobian[i] = one + b * k[i] + c * kk;
    }
}
inline void rotation_of_quaternion(const double* q, double* R) {
    const double norm = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    const double w = q[0] / norm, x = q[1] / norm, y = q[2] / norm, z = q[3] / norm;
    R[0] = 1.0 - 2.0 * (y * y + z * z); R[1] = 2.0 * (x * y - w * z); R[2] = 2.0 * (x * z + w * y);
    R[3] = 2.0 * (x * y + w * z); R[4] = 1.0 - 2.0 * (x * x + z * z); R[5] = 2.0 * (y * z - w * x);
    R[6] = 2.0 * (x * z - w * y); R[7] = 2.0 * (y * z + w * x); R[8] = 1.0 - 2.0 * (x * x + y * y);
}

// Compute the gradient with respect to the parameters from that of the left twist (ρ, φ) (fit/descent.py: AxisAngle,
// QuaternionMotion).
inline void by_axis(const double* numbers, const double* twist, double* gradient) {
    double R[9], jacobian[9];
    rotation_of_axis(numbers, R, jacobian);
    times(jacobian, twist + 3, gradient);
    times(R, twist, gradient + 3);
    for (int k = 0; k < 6; k++) gradient[k] = -gradient[k];
}
inline void by_quaternion(const double* q, const double* twist, double* gradient) {
    double g[3], across[3];
    cross_product(q + 4, twist, g);
    for (int k = 0; k < 3; k++) g[k] = twist[3 + k] - g[k];
    cross_product(g, q + 1, across);
    const double scale = 2.0 / (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    gradient[0] = -scale * (g[0] * q[1] + g[1] * q[2] + g[2] * q[3]);
    for (int k = 0; k < 3; k++) {
        gradient[1 + k] = scale * (q[0] * g[k] + across[k]);
        gradient[4 + k] = twist[k];
    }
}

// Compute the pose of the parameters, rows of [R | t].
inline void pose_of_axis(const double* numbers, double* T) {
    double R[9], jacobian[9];
    rotation_of_axis(numbers, R, jacobian);
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) T[4 * i + j] = R[3 * j + i];
        T[4 * i + 3] = -(R[i] * numbers[3] + R[3 + i] * numbers[4] + R[6 + i] * numbers[5]);
    }
}
inline void pose_of_quaternion(const double* numbers, const double* guess, double* T) {
    double R[9];
    rotation_of_quaternion(numbers, R);
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 4; j++) T[4 * i + j] = R[3 * i] * guess[j] + R[3 * i + 1] * guess[4 + j] + R[3 * i + 2] * guess[8 + j];
        T[4 * i + 3] += numbers[4 + i];
    }
}

// Return Adam's or AMSGrad's update of number k at a rate (fit/adam.py: VectorAdam, VectorAmsgrad).
inline double adam_update(Descending& d, const DescentNumbers& n, int k, double gradient, double rate) {
    d.moment1[k] += (1.0 - n.beta1) * (gradient - d.moment1[k]);
    d.moment2[k] += (1.0 - n.beta2) * (gradient * gradient - d.moment2[k]);
    d.largest[k] = fmax(d.largest[k], d.moment2[k]);
    const double steps = double(d.steps), spread = d.amsgrad > 0.0 ? d.largest[k] : d.moment2[k];
    const double unbiased1 = d.moment1[k] / (1.0 - pow(n.beta1, steps)), unbiased2 = spread / (1.0 - pow(n.beta2, steps));
    return -rate * unbiased1 / (sqrt(unbiased2) + n.epsilon);
}

inline void keep_best(Descending& d, double loss) {
    if (d.steps == 1) d.first = loss;
    if (!(loss < d.best) || (loss == 0.0 && d.steps > 1)) return;   // no common pixels: must not replace a pose that has some
    d.best = loss;
    for (int k = 0; k < 12; k++) d.best_T[k] = d.T[k];
    for (int k = 0; k < 2; k++) d.best_exposure[k] = d.exposure[k];
}

// Take a step from the loss and its gradients, in one block. Does nothing if the descent has stopped, or if pairs were
// missing.
KERNEL descend(Descending* descending, Shown* shown, DescentNumbers n, int axis, const double* losses, int loss_blocks,
               const double* twists, int twist_blocks, Pairs pairs) {
    double loss[3], twist[6], gradient[7];
    sum_blocks<3>(losses, loss_blocks, loss);
    sum_blocks<6>(twists, twist_blocks, twist);
    Descending& d = *descending;
    if (threadIdx.x || d.stopped || d.missing) return;
    if (*pairs.total > pairs.room) { d.missing = *pairs.total; return; }
    d.steps++;
    keep_best(d, loss[0]);
    const int rotations = axis ? 3 : 4;
    if (axis) by_axis(d.numbers, twist, gradient);
    else by_quaternion(d.numbers, twist, gradient);
    bool still = true;
    for (int k = 0; k < rotations + 3; k++) {
        const double moved = adam_update(d, n, k, gradient[k], k < rotations ? n.lr_rotation : n.lr_translation);
        d.numbers[k] += moved;
        still = still && fabs(moved) < n.update_stop;
    }
    for (int k = 0; k < 2; k++) d.exposure[k] += adam_update(d, n, 7 + k, loss[1 + k], n.lr_exposure);
    const bool lower = loss[0] < (1.0 - n.plateau_stop) * d.lowered;
    d.waited = lower ? 0 : d.waited + 1;
    if (lower) d.lowered = loss[0];
    d.stopped = still || (n.plateau_stop > 0.0 && double(d.waited) >= n.plateau_window);
    if (axis) pose_of_axis(d.numbers, d.T);
    else pose_of_quaternion(d.numbers, n.guess, d.T);
    for (int k = 0; k < 12; k++) shown->pose[k] = float(d.T[k]);
    shown->gain = expf(float(d.exposure[0]));
    shown->offset = float(d.exposure[1]);
}

}  // namespace sigmasplat
