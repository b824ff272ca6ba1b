// The steps of an alignment from their normal equations: solve, move, test, start the next level. In double precision,
// for one thread. fit/align.py `align` is the description. Has no includes and no namespace; the caller provides
// ::sqrt, ::fabs, ::sin and ::cos.

// Compute the eigenvalues of a symmetric 6×6 matrix, and its eigenvectors as columns of V, by cyclic Jacobi rotations.
inline void eigen6(double (*A)[6], double* values, double (*V)[6]) {
    for (int i = 0; i < 6; i++)
        for (int j = 0; j < 6; j++) V[i][j] = i == j;
    for (int sweep = 0; sweep < 30; sweep++) {
        double off = 0, all = 0;
        for (int i = 0; i < 6; i++)
            for (int j = 0; j < 6; j++) { all += A[i][j] * A[i][j]; if (i != j) off += A[i][j] * A[i][j]; }
        if (off <= 1e-30 * all) break;
        for (int p = 0; p < 5; p++)
            for (int q = p + 1; q < 6; q++) {
                if (A[p][q] == 0) continue;
                const double theta = (A[q][q] - A[p][p]) / (2 * A[p][q]);
                const double t = (theta < 0 ? -1 : 1) / (::fabs(theta) + ::sqrt(theta * theta + 1));
                const double c = 1 / ::sqrt(t * t + 1), s = t * c;
                for (int k = 0; k < 6; k++) { const double a = A[k][p], b = A[k][q]; A[k][p] = c * a - s * b; A[k][q] = s * a + c * b; }
                for (int k = 0; k < 6; k++) { const double a = A[p][k], b = A[q][k]; A[p][k] = c * a - s * b; A[q][k] = s * a + c * b; }
                for (int k = 0; k < 6; k++) { const double a = V[k][p], b = V[k][q]; V[k][p] = c * a - s * b; V[k][q] = s * a + c * b; }
            }
    }
    for (int i = 0; i < 6; i++) values[i] = A[i][i];
}

// Compute the Gauss–Newton update −H⁻¹ b in the directions whose information is above `share` of the largest one.
// Rotations are measured by the shift that they cause at depth_m. Returns the number of other directions (fit/align.py
// `_axes`).
inline int solve_decided(const double* H, const double* b, double depth_m, double share, double* update) {
    double A[6][6], V[6][6], values[6], best = 1e-300;
    for (int i = 0, q = 0; i < 6; i++)
        for (int j = i; j < 6; j++, q++) A[i][j] = A[j][i] = H[q] / ((i < 3 ? 1.0 : depth_m) * (j < 3 ? 1.0 : depth_m));
    eigen6(A, values, V);
    for (double v : values) best = v > best ? v : best;
    int left_out = 0;
    for (int i = 0; i < 6; i++) update[i] = 0;
    for (int k = 0; k < 6; k++) {
        if (!(values[k] > share * best)) { left_out++; continue; }
        double along = 0;
        for (int i = 0; i < 6; i++) along += V[i][k] * b[i] / (i < 3 ? 1.0 : depth_m);
        for (int i = 0; i < 6; i++) update[i] -= V[i][k] / (i < 3 ? 1.0 : depth_m) * along / values[k];
    }
    return left_out;
}

inline void copy(const double* from, int count, double* to) { for (int k = 0; k < count; k++) to[k] = from[k]; }

// T ← exp(twist) · T, where T is the first three rows of a rigid motion.
inline void move_left(const double* twist, double* T) {
    const double *r = twist, *w = twist + 3, theta2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2], theta = ::sqrt(theta2);
    const bool small = theta2 < 1e-12;
    const double a = small ? 1 - theta2 / 6 : ::sin(theta) / theta, b = small ? 0.5 - theta2 / 24 : (1 - ::cos(theta)) / theta2,
                 c = small ? 1.0 / 6 - theta2 / 120 : (1 - a) / theta2;
    const double K[3][3] = {{0, -w[2], w[1]}, {w[2], 0, -w[0]}, {-w[1], w[0], 0}};
    double E[3][4], moved[12];
    for (int i = 0; i < 3; i++) {
        E[i][3] = 0;
        for (int j = 0; j < 3; j++) {
            const double K2 = w[i] * w[j] - (i == j ? theta2 : 0);
            E[i][j] = (i == j) + a * K[i][j] + b * K2;
            E[i][3] += ((i == j) + b * K[i][j] + c * K2) * r[j];
        }
    }
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 4; j++) moved[4 * i + j] = E[i][0] * T[j] + E[i][1] * T[4 + j] + E[i][2] * T[8 + j] + (j == 3 ? E[i][3] : 0);
    copy(moved, 12, T);
}

constexpr double UNKNOWN_COST = 1.7976931348623157e308;

// The progress of an alignment. T: T_live_reference; sums: those of the last step, or of the best one if a level ended
// with it; best… and previous: values within a level; last…: gradient and update of the step before, an update of 0 at
// the start of a level; longer: factor of the last step (`lengthening`); degenerate: number of directions that the last
// step did not change; steps: on all levels; gain: factor on the gray of the live image, by which both are as bright.
struct Descent {
    double T[12], sums[5], best_T[12], best_sums[5], best, previous, last_b[6], last_update[6], longer, gain;
    int level, taken, steps, degenerate;
};

inline void begin_level(Descent& d, int level) {
    d.level = level;
    if (level < 0) return;                 // the finest level is done: its result is final
    d.best = d.previous = UNKNOWN_COST;
    for (double& u : d.last_update) u = 0;
    d.taken = 0;
    d.degenerate = 6;
}

inline Descent begin_descent(const double* T, int levels) {
    Descent d = {};
    copy(T, 12, d.T);
    d.longer = d.gain = 1;
    begin_level(d, levels - 1);
    return d;
}

constexpr double LONGEST = 3.0;            // maximum factor of a step
constexpr double GAIN_STOP = 1e-3;         // a smaller change of the gain changes gray by less than a step of 1/255

// Return by which factor the next step is longer than a Gauss–Newton step: by how much H exceeds the measured change of
// the gradient along the step before, sᵀHs / sᵀ(b − b₀), from 1 to LONGEST. H is computed from noisy image gradients, so
// it is too steep, and its steps are too short. The first step of a level has the factor of the last one before it.
inline double lengthening(const Descent& d, const double* H, const double* b) {
    const double* s = d.last_update;
    double expected = 0, measured = 0;
    for (int i = 0, q = 0; i < 6; i++) {
        measured += s[i] * (b[i] - d.last_b[i]);
        for (int j = i; j < 6; j++, q++) expected += (i == j ? 1 : 2) * H[q] * s[i] * s[j];
    }
    if (expected == 0) return d.longer;
    if (!(measured < expected)) return 1;
    return measured * LONGEST > expected ? expected / measured : LONGEST;
}

// Take the step of the normal equations at d.T, in the order of NORMAL_TERMS. The last step of a level starts the next
// level.
inline void take_step(Descent& d, const AlignLoop& o, const double* normal) {
    copy(normal + 27, 5, d.sums);
    d.steps++;
    d.taken++;
    const bool blind = d.sums[1] < o.min_pixels;
    bool settled = false;
    if (!blind) {
        double update[6];
        const double cost = d.sums[0] / d.sums[1];
        if (cost < d.best) { d.best = cost; copy(d.T, 12, d.best_T); copy(d.sums, 5, d.best_sums); }
        d.degenerate = solve_decided(normal, normal + 21, o.depth_m, o.degenerate_share, update);
        d.longer = lengthening(d, normal, normal + 21);
        for (double& u : update) u *= d.longer;
        copy(normal + 21, 6, d.last_b);
        copy(update, 6, d.last_update);
        move_left(update, d.T);
        const double gain = normal[53] > 0 ? normal[54] / normal[53] : d.gain;
        settled = ::fabs(gain - d.gain) < GAIN_STOP;
        d.gain = gain;
        for (double u : update) settled = settled && ::fabs(u) < o.update_stop * (1 << d.level);    // coarse pixels are larger
        settled = settled || ::fabs(cost - d.previous) < o.plateau_stop * cost;
        d.previous = cost;
    }
    if (!blind && !settled && d.taken < o.iterations) return;
    if (!settled && d.best < UNKNOWN_COST) { copy(d.best_T, 12, d.T); copy(d.best_sums, 5, d.sums); }
    begin_level(d, d.level - 1);
}
