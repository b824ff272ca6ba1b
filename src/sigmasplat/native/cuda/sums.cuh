// Sums over the threads of a block in a fixed order, without atomics, so that every run gives the same bytes.
#pragma once

#define KERNEL extern "C" __global__ void __launch_bounds__(256)

namespace sigmasplat {

constexpr int THREADS = 256;               // threads per block
constexpr unsigned ALL_LANES = 0xffffffffu;

inline int thread_number() { return int(blockIdx.x) * THREADS + int(threadIdx.x); }

// Sum COUNT numbers over all threads of a block, and store them as the block's sums. All threads must call this.
template <int COUNT> inline void store_sums(const float* values, double* partial) {
    __shared__ double of_warps[COUNT * THREADS / 32];
    const int lane = int(threadIdx.x) % 32, warp = int(threadIdx.x) / 32;
    for (int q = 0; q < COUNT; q++) {
        double sum = values[q];
        for (int apart = 16; apart > 0; apart /= 2) sum += __shfl_xor_sync(ALL_LANES, sum, apart);
        if (lane == 0) of_warps[q * (THREADS / 32) + warp] = sum;
    }
    __syncthreads();
    if (threadIdx.x < COUNT) {
        double sum = 0.0;
        for (int w = 0; w < THREADS / 32; w++) sum += of_warps[threadIdx.x * (THREADS / 32) + w];
        partial[size_t(blockIdx.x) * COUNT + threadIdx.x] = sum;
    }
}

}  // namespace sigmasplat
