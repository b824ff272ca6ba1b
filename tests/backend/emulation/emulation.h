// Run a CUDA kernel's text on the CPU, for tests: one block after another, its threads as fibers of one OS thread that hand over
// at every barrier and shuffle. What it checks besides the results: every thread of a block (of a warp) meets the same barrier
// (shuffle), or the run stops and names the line; shared memory is filled with NaNs before each block; the order in which threads
// run between two barriers is the caller's choice, and may not change a bit of the result.
#pragma once
#include <link.h>
#include <csetjmp>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <random>
#include <algorithm>
#include <type_traits>
#include <ucontext.h>
#include <utility>
#include <vector>

struct Index { unsigned x, y, z; };
struct float2 { float x, y; };
struct alignas(16) float4 { float x, y, z, w; };
inline float2 make_float2(float x, float y) { return {x, y}; }
inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }
inline float __int_as_float(int bits) { float x; memcpy(&x, &bits, 4); return x; }
inline int __float_as_int(float x) { int bits; memcpy(&bits, &x, 4); return bits; }
inline int atomicAdd(int* to, int value) { return std::exchange(*to, *to + value); }   // one thread runs at a time

namespace emulation {

constexpr int WARP = 32, MOST_THREADS = 1024;
constexpr size_t STACK = 64 << 10;

struct Meeting {                           // a barrier or a shuffle: everyone comes, then everyone goes on
    int members = 0, arrived = 0, line = 0, count = 0, result = 0;
    unsigned round = 0;
    uint64_t value[WARP];                  // what the lanes of a shuffle bring
};
struct Fiber { jmp_buf place; bool started, ended; };
enum Back { FIRST, HANDED_OVER, FAILED };

Fiber fibers[MOST_THREADS];
std::vector<char> stacks;
int turn[MOST_THREADS];                    // the order in which threads run
int at_once;                               // so many of them in turns until all of these wait, then the next
int current;                               // the thread that runs
unsigned events;                           // grows when a thread begins or ends and when a meeting is complete
Meeting whole_block, warps[MOST_THREADS / WARP];
jmp_buf scheduler;
ucontext_t beginning;
Index block;
void (*body)(void*);
void* arguments;
char message[200];

[[noreturn]] void fail(const char* text, int line) {
    snprintf(message, sizeof message, "%s, line %d", text, line);
    longjmp(scheduler, FAILED);
}

void meet(Meeting& m, int line) {
    if (m.arrived && m.line != line) fail("threads meet different barriers", line);
    m.line = line;
    const unsigned round = m.round;
    if (++m.arrived == m.members) {
        m.result = m.count;
        m.count = m.arrived = 0;
        m.round++;
        events++;
    }
    while (m.round == round)
        if (!setjmp(fibers[current].place)) longjmp(scheduler, HANDED_OVER);
}
int votes(Meeting& m, bool predicate, int line) {
    m.count += predicate;
    meet(m, line);
    return m.result;                       // stays until all have come again
}
Meeting& my_warp() { return warps[current / WARP]; }
template <class T> T from_lane(T value, int lane, int line) {
    static_assert(sizeof(T) <= 8);
    Meeting& m = my_warp();
    memcpy(&m.value[current % WARP], &value, sizeof value);
    meet(m, line);
    T other;
    memcpy(&other, &m.value[lane], sizeof other);
    meet(m, line);                         // nobody brings his next one before all have read
    return other;
}

// Shared memory is thread-local memory of this library, which has no other: that alone lies together (a section of their own is
// not given to variables of templates). The loader says where.
struct Memory { char* begin; size_t bytes; };
thread_local char landmark;
int find_landmark(dl_phdr_info* library, size_t, void* found) {
    for (int i = 0; i < library->dlpi_phnum; i++) {
        const auto& part = library->dlpi_phdr[i];
        char* begin = static_cast<char*>(library->dlpi_tls_data);
        if (part.p_type == PT_TLS && begin && &landmark >= begin && &landmark < begin + part.p_memsz)
            *static_cast<Memory*>(found) = {begin, part.p_memsz};
    }
    return 0;
}
Memory shared_memory() {
    Memory found{&landmark, 0};
    dl_iterate_phdr(find_landmark, &found);
    return found;
}

void live() {
    body(arguments);
    fibers[current].ended = true;
    events++;
    longjmp(scheduler, HANDED_OVER);
}

void resume() {
    Fiber& f = fibers[current];
    if (f.started) longjmp(f.place, 1);
    f.started = true;
    events++;
    getcontext(&beginning);
    beginning.uc_stack.ss_sp = &stacks[size_t(current) * STACK];
    beginning.uc_stack.ss_size = STACK;
    beginning.uc_link = nullptr;
    makecontext(&beginning, live, 0);
    setcontext(&beginning);
}

// Let the current thread run until it hands over.
Back step() {
    const int back = setjmp(scheduler);
    if (back == FIRST) resume();
    return Back(back);
}

// Returns false where threads cannot go on; `message` says why.
bool run_block(int threads) {
    static const Memory shared = shared_memory();
    if (!shared.bytes) {
        snprintf(message, sizeof message, "shared memory is not where it was looked for");
        return false;
    }
    memset(shared.begin, 0xff, shared.bytes);   // NaN, −1, true
    whole_block = Meeting();
    whole_block.members = threads;
    for (int w = 0; w * WARP < threads; w++) {
        warps[w] = Meeting();
        warps[w].members = std::min(WARP, threads - w * WARP);
    }
    for (int i = 0; i < threads; i++) fibers[i].started = fibers[i].ended = false;
    unsigned seen;                         // a round in which nothing happens is the last
    do {
        seen = events;
        for (int begin = 0; begin < threads; begin += at_once) {
            unsigned seen_here;
            do {
                seen_here = events;
                for (int at = begin; at < begin + at_once && at < threads; at++) {
                    current = turn[at];
                    if (!fibers[current].ended && step() == FAILED) return false;
                }
            } while (seen_here != events);
        }
    } while (seen != events);
    for (int i = 0; i < threads; i++)
        if (!fibers[i].ended) {
            snprintf(message, sizeof message, "threads wait for others that do not come, line %d",
                     whole_block.arrived ? whole_block.line : warps[i / WARP].line);
            return false;
        }
    return true;
}

template <auto KERNEL_FUNCTION> struct Call;
template <class... A, void (*FUNCTION)(A...)> struct Call<FUNCTION> {
    template <size_t... I> static void unpack(void** p, std::index_sequence<I...>) { FUNCTION(*static_cast<A*>(p[I])...); }
    static void run(void* p) { unpack(static_cast<void**>(p), std::index_sequence_for<A...>{}); }
};
struct Entry { const char* name; void (*run)(void*); };

// Run a kernel; null, or what went wrong. order: 0 = all threads in turns; 1 = warp by warp, each as far as it comes alone;
// 2 = the same backwards; else warps, and threads in each, shuffled from that seed.
const char* run(void (*kernel)(void*), int blocks, int threads, void** parameters, unsigned order) {
    if (stacks.empty()) stacks.resize(MOST_THREADS * STACK);
    at_once = order ? WARP : threads;
    for (int i = 0; i < threads; i++) turn[i] = order == 2 ? threads - 1 - i : i;
    if (order > 2 && threads % WARP == 0) {
        std::mt19937 random(order);
        int warp[MOST_THREADS / WARP];
        for (int w = 0; w < threads / WARP; w++) warp[w] = w;
        std::shuffle(warp, warp + threads / WARP, random);
        for (int i = 0; i < threads; i++) turn[i] = warp[i / WARP] * WARP + i % WARP;
        for (int w = 0; w < threads / WARP; w++) std::shuffle(turn + w * WARP, turn + (w + 1) * WARP, random);
    }
    body = kernel;
    arguments = parameters;
    block = Index{};
    for (int b = 0; b < blocks; b++) {
        block.x = unsigned(b);
        if (!run_block(threads)) return message;
    }
    return nullptr;
}

}  // namespace emulation

#define __global__
#define __launch_bounds__(n)
#define __align__(n) __attribute__((aligned(n)))
#define __shared__ static thread_local
#define inline static inline               // a function's shared memory is then this library's own
#define threadIdx (Index{unsigned(emulation::current), 0, 0})
#define blockIdx emulation::block
#define __syncthreads() emulation::meet(emulation::whole_block, __LINE__)
#define __syncthreads_and(p) (emulation::votes(emulation::whole_block, p, __LINE__) == emulation::whole_block.members)
#define __any_sync(mask, p) (emulation::votes(emulation::my_warp(), p, __LINE__) > 0)
#define __shfl_sync(mask, value, lane) emulation::from_lane(value, lane, __LINE__)
#define __shfl_xor_sync(mask, value, apart) emulation::from_lane(value, (emulation::current % 32) ^ (apart), __LINE__)
#define __threadfence() ((void)0)          // one OS thread: what is written is seen
inline unsigned atomicAdd(unsigned* counter, unsigned more) { return std::exchange(*counter, *counter + more); }
