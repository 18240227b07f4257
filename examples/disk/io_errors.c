/* Lets calls on files below one folder fail: a library for LD_PRELOAD, so that SQLite's own calls are among them.
 *
 * Calls are counted from io_errors_arm on, in all threads. Call number `at` fails with `error`; with `from_then_on`, so
 * does each later one whose kind is in `kinds` (a bit for each letter, a = 1). fsync is counted and does nothing: it is
 * slow, and no power is cut here.
 */
#define _GNU_SOURCE
#include <dirent.h>
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <unistd.h>

#define MOST 65536

static char root[4096];
static int armed, count, fail_at, fail_with, fail_on;
static unsigned fail_kinds;
static char seen[MOST];
static char ours[MOST]; /* open descriptors below the folder */
static pthread_mutex_t guard = PTHREAD_MUTEX_INITIALIZER;

void io_errors_arm(const char *folder, int at, int error, int from_then_on, unsigned kinds) {
    pthread_mutex_lock(&guard);
    snprintf(root, sizeof root, "%s", folder);
    count = 0;
    fail_at = at;
    fail_with = error;
    fail_on = from_then_on;
    fail_kinds = kinds;
    armed = 1;
    pthread_mutex_unlock(&guard);
}

/* End, and return how many calls were counted; their kinds are in io_errors_seen. */
int io_errors_disarm(void) {
    pthread_mutex_lock(&guard);
    armed = 0;
    pthread_mutex_unlock(&guard);
    return count;
}

const char *io_errors_seen(void) { return seen; }

static int below(const char *path) {
    size_t length = strlen(root);
    return armed && path && length && strncmp(path, root, length) == 0;
}

static int below_at(int folder, const char *path) {
    if (path && path[0] == '/')
        return below(path);
    return armed && folder >= 0 && folder < MOST && ours[folder];
}

static int ours_is(int descriptor) { return armed && descriptor >= 0 && descriptor < MOST && ours[descriptor]; }

/* Count a call; return whether it fails, with errno set. */
static int fails(char kind) {
    int failing;
    pthread_mutex_lock(&guard);
    if (count < MOST)
        seen[count] = kind;
    failing = count == fail_at || (fail_on && fail_at >= 0 && count > fail_at && (fail_kinds >> (kind - 'a') & 1));
    count++;
    pthread_mutex_unlock(&guard);
    if (failing)
        errno = fail_with;
    return failing;
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))
#define OPENED(descriptor, is_ours)                                                                                    \
    do {                                                                                                               \
        if ((descriptor) >= 0 && (descriptor) < MOST)                                                                  \
            ours[descriptor] = (is_ours);                                                                              \
    } while (0)

static mode_t mode_of(int flags, va_list more) {
    return flags & (O_CREAT | O_TMPFILE) ? (mode_t)va_arg(more, int) : 0;
}

static char opening(int flags) { return (flags & O_ACCMODE) == O_RDONLY ? 'a' : 'b'; }

#define OPEN(name)                                                                                                     \
    int name(const char *path, int flags, ...) {                                                                       \
        va_list more;                                                                                                  \
        va_start(more, flags);                                                                                         \
        mode_t mode = mode_of(flags, more);                                                                            \
        va_end(more);                                                                                                  \
        int is_ours = below(path);                                                                                     \
        if (is_ours && fails(opening(flags)))                                                                          \
            return -1;                                                                                                 \
        int descriptor = REAL(name)(path, flags, mode);                                                                \
        OPENED(descriptor, is_ours);                                                                                   \
        return descriptor;                                                                                             \
    }
OPEN(open)
OPEN(open64)

#define OPENAT(name)                                                                                                   \
    int name(int folder, const char *path, int flags, ...) {                                                           \
        va_list more;                                                                                                  \
        va_start(more, flags);                                                                                         \
        mode_t mode = mode_of(flags, more);                                                                            \
        va_end(more);                                                                                                  \
        int is_ours = below_at(folder, path);                                                                          \
        if (is_ours && fails(opening(flags)))                                                                          \
            return -1;                                                                                                 \
        int descriptor = REAL(name)(folder, path, flags, mode);                                                        \
        OPENED(descriptor, is_ours);                                                                                   \
        return descriptor;                                                                                             \
    }
OPENAT(openat)
OPENAT(openat64)

int close(int descriptor) {
    OPENED(descriptor, 0);
    return REAL(close)(descriptor);
}

#define ON_DESCRIPTOR(result, name, kind, parameters, ...)                                                             \
    result name parameters {                                                                                           \
        if (ours_is(descriptor) && fails(kind))                                                                        \
            return -1;                                                                                                 \
        return REAL(name)(__VA_ARGS__);                                                                                \
    }
ON_DESCRIPTOR(ssize_t, read, 'c', (int descriptor, void *data, size_t size), descriptor, data, size)
ON_DESCRIPTOR(ssize_t, pread, 'c', (int descriptor, void *data, size_t size, off_t at), descriptor, data, size, at)
ON_DESCRIPTOR(ssize_t, pread64, 'c', (int descriptor, void *data, size_t size, off64_t at), descriptor, data, size, at)
ON_DESCRIPTOR(ssize_t, write, 'd', (int descriptor, const void *data, size_t size), descriptor, data, size)
ON_DESCRIPTOR(ssize_t, pwrite, 'd', (int descriptor, const void *data, size_t size, off_t at), descriptor, data, size, at)
ON_DESCRIPTOR(ssize_t, pwrite64, 'd', (int descriptor, const void *data, size_t size, off64_t at), descriptor, data, size, at)
ON_DESCRIPTOR(int, ftruncate, 'f', (int descriptor, off_t size), descriptor, size)
ON_DESCRIPTOR(int, ftruncate64, 'f', (int descriptor, off64_t size), descriptor, size)
ON_DESCRIPTOR(int, fchmod, 'g', (int descriptor, mode_t mode), descriptor, mode)
ON_DESCRIPTOR(int, fstat, 'h', (int descriptor, struct stat *about), descriptor, about)
ON_DESCRIPTOR(int, fstat64, 'h', (int descriptor, struct stat64 *about), descriptor, about)

#define SYNC(name)                                                                                                     \
    int name(int descriptor) {                                                                                         \
        if (ours_is(descriptor))                                                                                       \
            return fails('e') ? -1 : 0;                                                                                \
        return REAL(name)(descriptor);                                                                                 \
    }
SYNC(fsync)
SYNC(fdatasync)

#define ON_PATH(result, failed, name, kind, parameters, ...)                                                           \
    result name parameters {                                                                                           \
        if (below(path) && fails(kind))                                                                                \
            return failed;                                                                                             \
        return REAL(name)(__VA_ARGS__);                                                                                \
    }
ON_PATH(int, -1, rename, 'g', (const char *path, const char *to), path, to)
ON_PATH(int, -1, unlink, 'g', (const char *path), path)
ON_PATH(int, -1, rmdir, 'g', (const char *path), path)
ON_PATH(int, -1, mkdir, 'j', (const char *path, mode_t mode), path, mode)
ON_PATH(int, -1, chmod, 'g', (const char *path, mode_t mode), path, mode)
ON_PATH(int, -1, stat, 'h', (const char *path, struct stat *about), path, about)
ON_PATH(int, -1, stat64, 'h', (const char *path, struct stat64 *about), path, about)
ON_PATH(int, -1, lstat, 'h', (const char *path, struct stat *about), path, about)
ON_PATH(int, -1, lstat64, 'h', (const char *path, struct stat64 *about), path, about)
ON_PATH(int, -1, access, 'h', (const char *path, int mode), path, mode)
ON_PATH(DIR *, NULL, opendir, 'i', (const char *path), path)

#define ON_PATH_AT(name, kind, parameters, ...)                                                                        \
    int name parameters {                                                                                              \
        if (below_at(folder, path) && fails(kind))                                                                     \
            return -1;                                                                                                 \
        return REAL(name)(__VA_ARGS__);                                                                                \
    }
ON_PATH_AT(unlinkat, 'g', (int folder, const char *path, int flags), folder, path, flags)
ON_PATH_AT(mkdirat, 'j', (int folder, const char *path, mode_t mode), folder, path, mode)
ON_PATH_AT(renameat, 'g', (int folder, const char *path, int to_folder, const char *to), folder, path, to_folder, to)
ON_PATH_AT(fstatat, 'h', (int folder, const char *path, struct stat *about, int flags), folder, path, about, flags)
ON_PATH_AT(fstatat64, 'h', (int folder, const char *path, struct stat64 *about, int flags), folder, path, about, flags)
ON_PATH_AT(faccessat, 'h', (int folder, const char *path, int mode, int flags), folder, path, mode, flags)
