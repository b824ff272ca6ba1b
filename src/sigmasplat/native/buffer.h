// Memory that is kept between iterations: a growing, 64-byte aligned array of plain values. It is in the namespace of
// the instruction set, so that the linker cannot use an inline function compiled for AVX-512 in code for another one.
template <class T> struct Buffer {
    T* data = nullptr;
    size_t capacity = 0;
    Buffer() = default;
    Buffer(const Buffer&) = delete;
    Buffer& operator=(const Buffer&) = delete;
    ~Buffer() { __builtin_free(data); }
    // Make room for n values. If the buffer grows, the old values are lost and the new memory is zero.
    T* reserve(size_t n) {
        if (n > capacity) {
            __builtin_free(data);
            capacity = n + n / 4 + 64;
            const size_t bytes = (capacity * sizeof(T) + 63) / 64 * 64;
            data = static_cast<T*>(aligned_alloc(64, bytes));
            if (!data) { capacity = 0; __builtin_trap(); }
            memset(static_cast<void*>(data), 0, bytes);
        }
        return data;
    }
    T& operator[](size_t i) { return data[i]; }
    const T& operator[](size_t i) const { return data[i]; }
};
