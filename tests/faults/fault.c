// Faults for one process, put in front of the C library with LD_PRELOAD. What is not asked for is not done.
//
//   FAULT_ROOT     folder whose files count; absolute
//   FAULT_AT       the operation there that fails, counted from 1: to open for writing, to write, to sync, to rename
//   FAULT_ERRNO    what it fails with
//   FAULT_LOG      file for what failed (its operation and path), and at the end the number of operations
//   FAULT_CPU_MS   ends the process at once after that much processor time, however busy the machine is
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/time.h>
#include <sys/uio.h>
#include <unistd.h>

static const char *root;
static size_t root_length;
static long fails_at;
static int fails_with;
static FILE *report;
static atomic_long operations;

static long number(const char *name) {
    const char *text = getenv(name);
    return text ? atol(text) : 0;
}

__attribute__((constructor)) static void begin(void) {
    long ms = number("FAULT_CPU_MS");
    if (ms > 0) {
        // SIGPROF, which nobody here handles, ends a process like SIGKILL: nothing of it runs any more.
        struct itimerval timer = {.it_value = {.tv_sec = ms / 1000, .tv_usec = ms % 1000 * 1000}};
        if (setitimer(ITIMER_PROF, &timer, NULL)) _exit(99);
    }
    if (getenv("FAULT_LOG")) report = fopen(getenv("FAULT_LOG"), "we");
    fails_at = number("FAULT_AT");
    fails_with = (int)number("FAULT_ERRNO");
    root_length = getenv("FAULT_ROOT") ? strlen(getenv("FAULT_ROOT")) : 0;
    // Last: from here on operations count.
    root = getenv("FAULT_ROOT");
}

__attribute__((destructor)) static void end(void) {
    if (report) fprintf(report, "operations %ld\n", (long)operations), fclose(report);
}

// Counts an operation; whether it is the one that fails.
static int fails(const char *operation, const char *path) {
    if (!root || !path || strncmp(path, root, root_length)) return 0;
    if (atomic_fetch_add(&operations, 1) + 1 != fails_at) return 0;
    if (report) fprintf(report, "%s %s\n", operation, path), fflush(report);
    errno = fails_with;
    return 1;
}

static const char *path_of(int fd) {
    static _Thread_local char path[4096];
    char link[32];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t length = root ? readlink(link, path, sizeof path - 1) : -1;
    if (length < 0) return NULL;
    path[length] = 0;
    return path;
}

#define NEXT(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

static int opens(int (*next)(const char *, int, ...), const char *path, int flags, mode_t mode) {
    if ((flags & O_ACCMODE) != O_RDONLY && fails("open", path)) return -1;
    return next(path, flags, mode);
}

#define OPEN(name)                                                  \
    int name(const char *path, int flags, ...) {                    \
        va_list more;                                               \
        va_start(more, flags);                                      \
        mode_t mode = flags & O_CREAT ? va_arg(more, mode_t) : 0;   \
        va_end(more);                                               \
        return opens(NEXT(name), path, flags, mode);                \
    }
OPEN(open)
OPEN(open64)

ssize_t write(int fd, const void *bytes, size_t length) {
    return fails("write", path_of(fd)) ? -1 : NEXT(write)(fd, bytes, length);
}

ssize_t writev(int fd, const struct iovec *parts, int count) {
    return fails("write", path_of(fd)) ? -1 : NEXT(writev)(fd, parts, count);
}

int fsync(int fd) { return fails("fsync", path_of(fd)) ? -1 : NEXT(fsync)(fd); }
int fdatasync(int fd) { return fails("fsync", path_of(fd)) ? -1 : NEXT(fdatasync)(fd); }
int rename(const char *from, const char *to) { return fails("rename", to) ? -1 : NEXT(rename)(from, to); }
