/* Stands before the C library's calls by which datagen changes files, counts those below one folder, and at a
 * chosen one kills the process or lets the call fail. Loaded by LD_PRELOAD; asleep until crash_points_arm.
 * A test compares them with the calls that the kernel sees.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/types.h>
#include <unistd.h>

enum { ASLEEP, KILL, KILL_HALF_WRITTEN, FAIL_ONCE, FAIL_FROM_HERE, COUNT };
enum { GO, FAIL, HALF };

static char folder[PATH_MAX];
static size_t folder_length;
static long at;
static int mode, error_number, log_fd = -1;
static long calls;

#define REAL(name)                                                                                           \
    static __typeof__(&name) real_##name;                                                                    \
    if (!real_##name) real_##name = (__typeof__(&name))dlsym(RTLD_NEXT, #name)

static long plain_syscall(long number, long a, long b, long c)
{
    static long (*real)(long, ...);
    if (!real) real = (long (*)(long, ...))dlsym(RTLD_NEXT, "syscall");
    return real(number, a, b, c);
}

void crash_points_arm(const char *below, int new_mode, long new_at, int new_error, int new_log_fd)
{
    strncpy(folder, below, sizeof folder - 1);
    folder_length = strlen(folder);
    at = new_at;
    error_number = new_error;
    log_fd = new_log_fd;
    calls = 0;
    mode = new_mode;
}

void crash_points_disarm(void) { mode = ASLEEP; }

static int below_folder(const char *path)
{
    return strncmp(path, folder, folder_length) == 0 && (path[folder_length] == '/' || !path[folder_length]);
}

/* The absolute path of a file descriptor or of a name relative to one; 0 where it is not in the folder. */
static int fd_path(int fd, char *out)
{
    char link[64];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t size = readlink(link, out, PATH_MAX - 1);
    if (size < 0) return 0;
    out[size] = 0;
    return below_folder(out);
}

static int name_path(int dir, const char *name, char *out)
{
    if (!name) return 0;
    if (name[0] == '/') {
        snprintf(out, PATH_MAX, "%s", name);
        return below_folder(out);
    }
    char base[PATH_MAX];
    if (dir == AT_FDCWD) {
        if (!getcwd(base, sizeof base)) return 0;
    } else {
        fd_path(dir, base);
    }
    if (snprintf(out, PATH_MAX, "%s/%s", base, name) >= PATH_MAX) return 0;
    return below_folder(out);
}

static void die(void)
{
    plain_syscall(SYS_kill, getpid(), SIGKILL, 0);
    for (;;) pause();
}

/* What becomes of one call: counted, written to the log, and at the chosen one not done. `takes` says
 * whether it needs room on the disk. */
static int gate(const char *call, int takes, const char *path)
{
    long number = __atomic_add_fetch(&calls, 1, __ATOMIC_SEQ_CST);
    if (log_fd >= 0) {
        char line[PATH_MAX + 64];
        int size = snprintf(line, sizeof line, "%s %s\n", call, path);
        plain_syscall(SYS_write, log_fd, (long)line, size);
    }
    if (mode == KILL_HALF_WRITTEN && number == at && strcmp(call, "write") == 0) return HALF;
    if ((mode == KILL || mode == KILL_HALF_WRITTEN) && number == at) die();
    if ((mode == FAIL_ONCE && number == at) || (mode == FAIL_FROM_HERE && number >= at && takes)) {
        errno = error_number;
        return FAIL;
    }
    return GO;
}

#define NAMED(call, takes, dir, name, failed)                                                                \
    do {                                                                                                     \
        char path[PATH_MAX];                                                                                 \
        if (mode && name_path(dir, name, path) && gate(call, takes, path) == FAIL) return failed;            \
    } while (0)
#define OPENED(call, takes, fd, failed)                                                                      \
    do {                                                                                                     \
        char path[PATH_MAX];                                                                                 \
        if (mode && fd_path(fd, path) && gate(call, takes, path) == FAIL) return failed;                     \
    } while (0)
#define CHANGES(flags) ((flags) & (O_CREAT | O_TRUNC | O_WRONLY | O_RDWR))
#define MODE_OF(flags)                                                                                       \
    mode_t bits = 0;                                                                                         \
    if ((flags) & (O_CREAT | __O_TMPFILE)) {                                                                 \
        va_list list;                                                                                        \
        va_start(list, flags);                                                                               \
        bits = va_arg(list, mode_t);                                                                         \
        va_end(list);                                                                                        \
    }

#define OPEN(name)                                                                                           \
    int name(const char *file, int flags, ...)                                                               \
    {                                                                                                        \
        REAL(name);                                                                                          \
        MODE_OF(flags)                                                                                       \
        if (CHANGES(flags)) NAMED("open", (flags & O_CREAT) != 0, AT_FDCWD, file, -1);                       \
        return real_##name(file, flags, bits);                                                               \
    }
OPEN(open)
OPEN(open64)

#define OPENAT(name)                                                                                         \
    int name(int dir, const char *file, int flags, ...)                                                      \
    {                                                                                                        \
        REAL(name);                                                                                          \
        MODE_OF(flags)                                                                                       \
        if (CHANGES(flags)) NAMED("open", (flags & O_CREAT) != 0, dir, file, -1);                            \
        return real_##name(dir, file, flags, bits);                                                          \
    }
OPENAT(openat)
OPENAT(openat64)

/* A write may also stop in its middle. */
ssize_t write(int fd, const void *data, size_t size)
{
    REAL(write);
    char path[PATH_MAX];
    if (mode && fd_path(fd, path)) {
        int fate = gate("write", 1, path);
        if (fate == FAIL) return -1;
        if (fate == HALF) {
            real_write(fd, data, size / 2);
            die();
        }
    }
    return real_write(fd, data, size);
}

/* What is killed here loses no page that the kernel has, so files need not reach the disk. */
#define SYNC(name)                                                                                           \
    int name(int fd)                                                                                         \
    {                                                                                                        \
        REAL(name);                                                                                          \
        OPENED("fsync", 1, fd, -1);                                                                          \
        return mode && mode != COUNT ? 0 : real_##name(fd);                                                  \
    }
SYNC(fsync)
SYNC(fdatasync)

int rename(const char *from, const char *to)
{
    REAL(rename);
    NAMED("rename", 1, AT_FDCWD, from, -1);
    return real_rename(from, to);
}

int renameat(int from_dir, const char *from, int to_dir, const char *to)
{
    REAL(renameat);
    NAMED("rename", 1, from_dir, from, -1);
    return real_renameat(from_dir, from, to_dir, to);
}

int link(const char *from, const char *to)
{
    REAL(link);
    NAMED("link", 1, AT_FDCWD, to, -1);
    return real_link(from, to);
}

int linkat(int from_dir, const char *from, int to_dir, const char *to, int flags)
{
    REAL(linkat);
    NAMED("link", 1, to_dir, to, -1);
    return real_linkat(from_dir, from, to_dir, to, flags);
}

int unlink(const char *file)
{
    REAL(unlink);
    NAMED("unlink", 0, AT_FDCWD, file, -1);
    return real_unlink(file);
}

int unlinkat(int dir, const char *file, int flags)
{
    REAL(unlinkat);
    NAMED(flags & AT_REMOVEDIR ? "rmdir" : "unlink", 0, dir, file, -1);
    return real_unlinkat(dir, file, flags);
}

int rmdir(const char *file)
{
    REAL(rmdir);
    NAMED("rmdir", 0, AT_FDCWD, file, -1);
    return real_rmdir(file);
}

int mkdir(const char *file, mode_t bits)
{
    REAL(mkdir);
    NAMED("mkdir", 1, AT_FDCWD, file, -1);
    return real_mkdir(file, bits);
}

int mkdirat(int dir, const char *file, mode_t bits)
{
    REAL(mkdirat);
    NAMED("mkdir", 1, dir, file, -1);
    return real_mkdirat(dir, file, bits);
}
