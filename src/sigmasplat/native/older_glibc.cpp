// Keep the module loadable with a C library older than the one it was built with, as far as one name decides that.
// A C++ library built against glibc 2.32 or newer asks this flag whether it may count references without atomics; linked in
// statically, it finds the answer here ("there are several threads", always right) instead of in a glibc that must have it.
extern "C" {
[[gnu::visibility("hidden")]] extern char __libc_single_threaded;
char __libc_single_threaded = 0;
}
