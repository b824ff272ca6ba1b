// Make the module loadable with a C library older than the one it was built with, as far as one symbol is concerned. A
// C++ library built with glibc 2.32 or newer reads this flag to decide whether to count references without atomics. It
// is linked in statically and finds the flag here, so the system's glibc need not have it. The value "there are several
// threads" is always safe.
extern "C" {
[[gnu::visibility("hidden")]] extern char __libc_single_threaded;
char __libc_single_threaded = 0;
}
