// Sort a tile's splats by depth. An item is (depth's bits << 32 | splat). Positive floats have the same order as their
// bits.

constexpr int DIGIT = 8;                              // bits sorted by one pass

// Try an insertion sort of n items with at most `limit` moves. Returns whether that was enough.
SIGMA_INLINE bool insertion_sort(uint64_t* a, int n, int limit) {
    for (int i = 1; i < n; i++) {
        const uint64_t x = a[i];
        int j = i - 1;
        for (; j >= 0 && a[j] > x; j--) a[j + 1] = a[j];
        a[j + 1] = x;
        limit -= i - 1 - j;
        if (limit < 0) return false;
    }
    return true;
}
// Sort by `bits` bits of the depth above `low`, from bit `shift` on, stable: PASSES digits, the least significant
// first.
template <int PASSES> static void radix_sort(uint64_t* a, uint64_t* spare, int n, uint32_t low, int shift, int bits) {
    const int digit = (bits + PASSES - 1) / PASSES;
    const uint32_t mask = (1u << digit) - 1;
    uint32_t counts[PASSES][1 << DIGIT];
    memset(counts, 0, sizeof(counts));
    for (int i = 0; i < n; i++) {
        const uint32_t key = (uint32_t(a[i] >> 32) - low) >> shift;
        for (int p = 0; p < PASSES; p++) counts[p][key >> (p * digit) & mask]++;
    }
    uint64_t *from = a, *to = spare;
    for (int p = 0; p < PASSES; p++) {
        uint32_t sum = 0;
        for (uint32_t d = 0; d <= mask; d++) { const uint32_t c = counts[p][d]; counts[p][d] = sum; sum += c; }
        for (int i = 0; i < n; i++) to[counts[p][(uint32_t(from[i] >> 32) - low) >> (shift + p * digit) & mask]++] = from[i];
        uint64_t* t = from; from = to; to = t;
    }
    if (from != a) memcpy(a, from, size_t(n) * sizeof *a);
}
// Sort (depth bits << 32 | splat) by depth; stable.
static void sort_tile(uint64_t* a, uint64_t* spare, int n) {
    if (n <= 24) {
        insertion_sort(a, n, 24 * 24);
        return;
    }
    uint32_t low = ~0u, high = 0;
    for (int i = 0; i < n; i++) {
        const uint32_t key = a[i] >> 32;
        low = key < low ? key : low;
        high = key > high ? key : high;
    }
    const int bits = high > low ? 32 - __builtin_clz(high - low) : 1, below = bits > 2 * DIGIT ? bits - 2 * DIGIT : 0;
    radix_sort<2>(a, spare, n, low, below, bits - below);
    // After sorting by the upper two digits, a tile is nearly sorted, unless most depths are almost equal.
    if (below && !insertion_sort(a, n, 4 * n)) radix_sort<4>(a, spare, n, low, 0, bits);
}
