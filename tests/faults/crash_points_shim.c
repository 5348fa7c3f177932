/* Stands before the C library's calls that change files, counts those below one folder, and at a chosen
 * one kills the process or lets the call fail. Loaded by LD_PRELOAD; asleep until crash_points_arm.
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
#include <sys/uio.h>
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

long crash_points_calls(void) { return calls; }

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
/* A write may also stop in its middle. */
#define WRITTEN(fd, half)                                                                                    \
    do {                                                                                                     \
        char path[PATH_MAX];                                                                                 \
        if (mode && fd_path(fd, path)) {                                                                     \
            int fate = gate("write", 1, path);                                                               \
            if (fate == FAIL) return -1;                                                                     \
            if (fate == HALF) {                                                                              \
                half;                                                                                        \
                die();                                                                                       \
            }                                                                                                \
        }                                                                                                    \
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

#define CREAT(name)                                                                                          \
    int name(const char *file, mode_t bits)                                                                  \
    {                                                                                                        \
        REAL(name);                                                                                          \
        NAMED("open", 1, AT_FDCWD, file, -1);                                                                \
        return real_##name(file, bits);                                                                      \
    }
CREAT(creat)
CREAT(creat64)

ssize_t write(int fd, const void *data, size_t size)
{
    REAL(write);
    WRITTEN(fd, real_write(fd, data, size / 2));
    return real_write(fd, data, size);
}

#define PWRITE(name, offset_type)                                                                            \
    ssize_t name(int fd, const void *data, size_t size, offset_type offset)                                  \
    {                                                                                                        \
        REAL(name);                                                                                          \
        WRITTEN(fd, real_##name(fd, data, size / 2, offset));                                                \
        return real_##name(fd, data, size, offset);                                                          \
    }
PWRITE(pwrite, off_t)
PWRITE(pwrite64, off64_t)

ssize_t writev(int fd, const struct iovec *parts, int count)
{
    REAL(writev);
    WRITTEN(fd, real_writev(fd, parts, count / 2));
    return real_writev(fd, parts, count);
}

#define PWRITEV(name, offset_type)                                                                           \
    ssize_t name(int fd, const struct iovec *parts, int count, offset_type offset)                           \
    {                                                                                                        \
        REAL(name);                                                                                          \
        WRITTEN(fd, real_##name(fd, parts, count / 2, offset));                                              \
        return real_##name(fd, parts, count, offset);                                                        \
    }
PWRITEV(pwritev, off_t)
PWRITEV(pwritev64, off64_t)

#define SENDFILE(name, offset_type)                                                                          \
    ssize_t name(int out, int in, offset_type *offset, size_t size)                                          \
    {                                                                                                        \
        REAL(name);                                                                                          \
        WRITTEN(out, real_##name(out, in, offset, size / 2));                                                \
        return real_##name(out, in, offset, size);                                                           \
    }
SENDFILE(sendfile, off_t)
SENDFILE(sendfile64, off64_t)

ssize_t copy_file_range(int in, off64_t *from, int out, off64_t *to, size_t size, unsigned flags)
{
    REAL(copy_file_range);
    WRITTEN(out, real_copy_file_range(in, from, out, to, size / 2, flags));
    return real_copy_file_range(in, from, out, to, size, flags);
}

#define TRUNCATE(name, offset_type)                                                                          \
    int name(const char *file, offset_type size)                                                             \
    {                                                                                                        \
        REAL(name);                                                                                          \
        NAMED("truncate", 0, AT_FDCWD, file, -1);                                                            \
        return real_##name(file, size);                                                                      \
    }
TRUNCATE(truncate, off_t)
TRUNCATE(truncate64, off64_t)

#define FTRUNCATE(name, offset_type)                                                                         \
    int name(int fd, offset_type size)                                                                       \
    {                                                                                                        \
        REAL(name);                                                                                          \
        OPENED("truncate", 0, fd, -1);                                                                       \
        return real_##name(fd, size);                                                                        \
    }
FTRUNCATE(ftruncate, off_t)
FTRUNCATE(ftruncate64, off64_t)

#define FALLOCATE(name, offset_type)                                                                         \
    int name(int fd, int how, offset_type start, offset_type size)                                           \
    {                                                                                                        \
        REAL(name);                                                                                          \
        OPENED("fallocate", 1, fd, -1);                                                                      \
        return real_##name(fd, how, start, size);                                                            \
    }
FALLOCATE(fallocate, off_t)
FALLOCATE(fallocate64, off64_t)

#define POSIX_FALLOCATE(name, offset_type)                                                                   \
    int name(int fd, offset_type start, offset_type size)                                                    \
    {                                                                                                        \
        REAL(name);                                                                                          \
        OPENED("fallocate", 1, fd, error_number);                                                            \
        return real_##name(fd, start, size);                                                                 \
    }
POSIX_FALLOCATE(posix_fallocate, off_t)
POSIX_FALLOCATE(posix_fallocate64, off64_t)

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

int renameat2(int from_dir, const char *from, int to_dir, const char *to, unsigned flags)
{
    REAL(renameat2);
    NAMED("rename", 1, from_dir, from, -1);
    return real_renameat2(from_dir, from, to_dir, to, flags);
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

int symlink(const char *text, const char *to)
{
    REAL(symlink);
    NAMED("symlink", 1, AT_FDCWD, to, -1);
    return real_symlink(text, to);
}

int symlinkat(const char *text, int dir, const char *to)
{
    REAL(symlinkat);
    NAMED("symlink", 1, dir, to, -1);
    return real_symlinkat(text, dir, to);
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

int remove(const char *file)
{
    REAL(remove);
    NAMED("unlink", 0, AT_FDCWD, file, -1);
    return real_remove(file);
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

int chmod(const char *file, mode_t bits)
{
    REAL(chmod);
    NAMED("chmod", 0, AT_FDCWD, file, -1);
    return real_chmod(file, bits);
}

int fchmod(int fd, mode_t bits)
{
    REAL(fchmod);
    OPENED("chmod", 0, fd, -1);
    return real_fchmod(fd, bits);
}

int fchmodat(int dir, const char *file, mode_t bits, int flags)
{
    REAL(fchmodat);
    NAMED("chmod", 0, dir, file, -1);
    return real_fchmodat(dir, file, bits, flags);
}

int utimensat(int dir, const char *file, const struct timespec times[2], int flags)
{
    REAL(utimensat);
    NAMED("utimens", 0, dir, file, -1);
    return real_utimensat(dir, file, times, flags);
}

int futimens(int fd, const struct timespec times[2])
{
    REAL(futimens);
    OPENED("utimens", 0, fd, -1);
    return real_futimens(fd, times);
}

/* Calls made by number end in the functions above. */
long syscall(long number, ...)
{
    static long (*real)(long, ...);
    if (!real) real = (long (*)(long, ...))dlsym(RTLD_NEXT, "syscall");
    long a[6];
    va_list list;
    va_start(list, number);
    for (int i = 0; i < 6; i++) a[i] = va_arg(list, long);
    va_end(list);
    if (mode) {
        switch (number) {
        case SYS_openat: return openat(a[0], (const char *)a[1], a[2], (mode_t)a[3]);
        case SYS_write: return write(a[0], (const void *)a[1], a[2]);
        case SYS_pwrite64: return pwrite64(a[0], (const void *)a[1], a[2], a[3]);
        case SYS_writev: return writev(a[0], (const struct iovec *)a[1], a[2]);
        case SYS_renameat2: return renameat2(a[0], (const char *)a[1], a[2], (const char *)a[3], a[4]);
        case SYS_linkat: return linkat(a[0], (const char *)a[1], a[2], (const char *)a[3], a[4]);
        case SYS_symlinkat: return symlinkat((const char *)a[0], a[1], (const char *)a[2]);
        case SYS_unlinkat: return unlinkat(a[0], (const char *)a[1], a[2]);
        case SYS_mkdirat: return mkdirat(a[0], (const char *)a[1], a[2]);
        case SYS_ftruncate: return ftruncate64(a[0], a[1]);
        case SYS_fsync: return fsync(a[0]);
        case SYS_fdatasync: return fdatasync(a[0]);
        case SYS_fchmodat: return fchmodat(a[0], (const char *)a[1], a[2], 0);
        case SYS_copy_file_range:
            return copy_file_range(a[0], (off64_t *)a[1], a[2], (off64_t *)a[3], a[4], a[5]);
        }
    }
    return real(number, a[0], a[1], a[2], a[3], a[4], a[5]);
}
