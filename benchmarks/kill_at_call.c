/* Preloaded by benchmarks/kills.py: counts the calls of the C library that change files, and ends
   the process by SIGKILL before a chosen one, or in the middle of it where it is a write; or lets
   calls fail from a chosen one on, as on a disk whose quota is used up, or that is read-only from
   then on. Libraries in C, C++ and Rust are counted like Python.
   Build: cc -shared -fPIC -O1 -o FILE kill_at_call.c -ldl */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

static volatile long seen, chosen;
static volatile int torn, error, every;

/* Begin to count; at: number of the call before which the process ends, 0 for none; tear: whether a
   write is done by half first. */
void kill_arm(long at, int tear) { seen = 0; chosen = at; torn = tear; error = 0; }

/* Begin to count; from call `at` on calls fail with the error number `code`, a write after half of
   it; all: whether also calls that take no room fail (renaming, removing). */
void fail_arm(long at, int code, int all) { seen = 0; chosen = at; error = code; every = all; }

long kill_seen(void) { return seen; }

static void die(void) { kill(getpid(), SIGKILL); for (;;) pause(); }

/* Count a call: 0, it is done; 1, a write is done by half; -1, it fails. */
static int step(int is_write, int takes_room) {
    long now = __sync_add_and_fetch(&seen, 1);
    if (!chosen) return 0;
    if (error) {
        if (now < chosen || !(takes_room || every)) return 0;
        if (is_write && now == chosen) return 1;
        errno = error;
        return -1;
    }
    if (now != chosen) return 0;
    if (torn && is_write) return 1;
    die();
    return 0;
}

/* End in the middle of a write, of which `done` bytes were written. */
static ssize_t half(ssize_t done) {
    if (!error) die();
    return done;
}

static int is_file(int fd) {
    struct stat about;
    return fstat(fd, &about) == 0 && S_ISREG(about.st_mode);
}

#define REAL(type, name, ...) \
    static type (*real)(__VA_ARGS__); \
    if (!real) real = (type (*)(__VA_ARGS__))dlsym(RTLD_NEXT, name)

ssize_t write(int fd, const void *data, size_t size) {
    REAL(ssize_t, "write", int, const void *, size_t);
    int how = is_file(fd) ? step(size > 1, 1) : 0;
    return how < 0 ? -1 : how ? half(real(fd, data, size / 2)) : real(fd, data, size);
}

ssize_t pwrite64(int fd, const void *data, size_t size, off64_t at) {
    REAL(ssize_t, "pwrite64", int, const void *, size_t, off64_t);
    int how = is_file(fd) ? step(size > 1, 1) : 0;
    return how < 0 ? -1 : how ? half(real(fd, data, size / 2, at)) : real(fd, data, size, at);
}

ssize_t pwrite(int fd, const void *data, size_t size, off_t at) { return pwrite64(fd, data, size, at); }

ssize_t writev(int fd, const struct iovec *parts, int count) {
    REAL(ssize_t, "writev", int, const struct iovec *, int);
    int how = is_file(fd) ? step(count > 1, 1) : 0;
    return how < 0 ? -1 : how ? half(real(fd, parts, count / 2)) : real(fd, parts, count);
}

ssize_t sendfile64(int to, int from, off64_t *at, size_t size) {
    REAL(ssize_t, "sendfile64", int, int, off64_t *, size_t);
    int how = is_file(to) ? step(size > 1, 1) : 0;
    return how < 0 ? -1 : how ? half(real(to, from, at, size / 2)) : real(to, from, at, size);
}

ssize_t sendfile(int to, int from, off_t *at, size_t size) { return sendfile64(to, from, at, size); }

#define MODE(flags) \
    mode_t mode = 0; \
    if ((flags & O_CREAT) || (flags & O_TMPFILE) == O_TMPFILE) { va_list more; va_start(more, flags); mode = va_arg(more, mode_t); va_end(more); } \
    if ((flags & (O_CREAT | O_TRUNC)) && step(0, flags & O_CREAT) < 0) return -1

int open64(const char *path, int flags, ...) {
    MODE(flags);
    REAL(int, "open64", const char *, int, ...);
    return real(path, flags, mode);
}

int open(const char *path, int flags, ...) {
    MODE(flags);
    REAL(int, "open", const char *, int, ...);
    return real(path, flags, mode);
}

int openat64(int folder, const char *path, int flags, ...) {
    MODE(flags);
    REAL(int, "openat64", int, const char *, int, ...);
    return real(folder, path, flags, mode);
}

int openat(int folder, const char *path, int flags, ...) {
    MODE(flags);
    REAL(int, "openat", int, const char *, int, ...);
    return real(folder, path, flags, mode);
}

#define COUNTED(name, declared, types, given, takes_room) \
    int name declared { REAL(int, #name, types); return step(0, takes_room) < 0 ? -1 : real given; }
#define T(...) __VA_ARGS__

COUNTED(rename, (const char *a, const char *b), T(const char *, const char *), (a, b), 0)
COUNTED(renameat, (int f, const char *a, int g, const char *b), T(int, const char *, int, const char *), (f, a, g, b), 0)
COUNTED(link, (const char *a, const char *b), T(const char *, const char *), (a, b), 1)
COUNTED(symlink, (const char *a, const char *b), T(const char *, const char *), (a, b), 1)
COUNTED(unlink, (const char *a), T(const char *), (a), 0)
COUNTED(unlinkat, (int f, const char *a, int g), T(int, const char *, int), (f, a, g), 0)
COUNTED(rmdir, (const char *a), T(const char *), (a), 0)
COUNTED(mkdir, (const char *a, mode_t m), T(const char *, mode_t), (a, m), 1)
COUNTED(mkdirat, (int f, const char *a, mode_t m), T(int, const char *, mode_t), (f, a, m), 1)
COUNTED(ftruncate64, (int f, off64_t n), T(int, off64_t), (f, n), 0)
COUNTED(truncate64, (const char *a, off64_t n), T(const char *, off64_t), (a, n), 0)
COUNTED(chmod, (const char *a, mode_t m), T(const char *, mode_t), (a, m), 0)
