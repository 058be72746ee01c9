/* Lets writes below a folder fail, and steps the wall clock: loaded before the C library.

   cc -shared -fPIC -O2 -o disturb.so disturb.c -ldl; LD_PRELOAD=./disturb.so program

   What counts as a write: creating, writing, resizing, syncing and renaming a file in the folder. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <string.h>
#include <sys/time.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <time.h>
#include <unistd.h>

static char folder[4096];
static atomic_long seen, first, last; /* writes so far; those that fail, both included */
static atomic_int error;
static atomic_llong step_ns;

/* Let the `at`-th write from now on fail, and `count` - 1 more; 0: none. */
void disturb_writes(const char *below, long at, long count, int error_number) {
    snprintf(folder, sizeof folder, "%s/", below);
    error = error_number;
    seen = 0;
    last = 0;
    first = at;
    last = count ? at + count - 1 : 0;
}

long disturb_seen(void) { return seen; }

void disturb_clock(long long ns) { step_ns = ns; }

static int fails(const char *path) {
    if (!folder[0] || strncmp(path, folder, strlen(folder))) return 0;
    long number = ++seen;
    if (number < first || number > last) return 0;
    errno = error;
    return 1;
}

static int fails_at(int fd) {
    char link[64], path[4096];
    if (!folder[0]) return 0;
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t length = readlink(link, path, sizeof path - 1);
    if (length < 0) return 0;
    path[length] = 0;
    return fails(path);
}

#define REAL(type, name, ...) ((type(*)(__VA_ARGS__))dlsym(RTLD_NEXT, #name))
#define ON_FD(type, name, parameters, arguments, ...)        \
    type name parameters {                                   \
        static type (*real)(__VA_ARGS__);                    \
        if (!real) real = REAL(type, name, __VA_ARGS__);     \
        return fails_at(fd) ? -1 : real arguments;           \
    }

ON_FD(ssize_t, write, (int fd, const void *data, size_t size), (fd, data, size), int, const void *,
      size_t)
ON_FD(ssize_t, pwrite, (int fd, const void *data, size_t size, off_t at), (fd, data, size, at), int,
      const void *, size_t, off_t)
ON_FD(ssize_t, pwrite64, (int fd, const void *data, size_t size, off64_t at), (fd, data, size, at),
      int, const void *, size_t, off64_t)
ON_FD(ssize_t, writev, (int fd, const struct iovec *parts, int count), (fd, parts, count), int,
      const struct iovec *, int)
ON_FD(int, fsync, (int fd), (fd), int)
ON_FD(int, fdatasync, (int fd), (fd), int)
ON_FD(int, ftruncate, (int fd, off_t size), (fd, size), int, off_t)
ON_FD(int, ftruncate64, (int fd, off64_t size), (fd, size), int, off64_t)

/* It returns its error. */
#define FALLOCATE(name, offset)                                              \
    int name(int fd, offset at, offset size) {                               \
        static int (*real)(int, offset, offset);                             \
        if (!real) real = REAL(int, name, int, offset, offset);              \
        return fails_at(fd) ? error : real(fd, at, size);                    \
    }
FALLOCATE(posix_fallocate, off_t)
FALLOCATE(posix_fallocate64, off64_t)

#define OPEN(name, parameters, arguments, ...)                               \
    int name parameters {                                                    \
        static int (*real)(__VA_ARGS__, ...);                                \
        if (!real) real = (int (*)(__VA_ARGS__, ...))dlsym(RTLD_NEXT, #name); \
        va_list rest;                                                        \
        va_start(rest, flags);                                               \
        mode_t mode = flags & (O_CREAT | O_TMPFILE) ? va_arg(rest, mode_t) : 0; \
        va_end(rest);                                                        \
        int creates = flags & O_CREAT && access(path, F_OK);                 \
        return creates && fails(path) ? -1 : real arguments;                 \
    }
OPEN(open, (const char *path, int flags, ...), (path, flags, mode), const char *, int)
OPEN(open64, (const char *path, int flags, ...), (path, flags, mode), const char *, int)
OPEN(openat, (int at, const char *path, int flags, ...), (at, path, flags, mode), int, const char *,
     int)
OPEN(openat64, (int at, const char *path, int flags, ...), (at, path, flags, mode), int,
     const char *, int)

int rename(const char *from, const char *to) {
    static int (*real)(const char *, const char *);
    if (!real) real = REAL(int, rename, const char *, const char *);
    return fails(to) ? -1 : real(from, to);
}

int renameat(int from_at, const char *from, int to_at, const char *to) {
    static int (*real)(int, const char *, int, const char *);
    if (!real) real = REAL(int, renameat, int, const char *, int, const char *);
    return fails(to) ? -1 : real(from_at, from, to_at, to);
}

int clock_gettime(clockid_t clock, struct timespec *now) {
    static int (*real)(clockid_t, struct timespec *);
    if (!real) real = REAL(int, clock_gettime, clockid_t, struct timespec *);
    int failed = real(clock, now);
    if (clock != CLOCK_REALTIME || failed || !step_ns) return failed;
    long long ns = now->tv_sec * 1000000000LL + now->tv_nsec + step_ns;
    now->tv_sec = ns / 1000000000LL;
    now->tv_nsec = ns % 1000000000LL;
    return 0;
}
