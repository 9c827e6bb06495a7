/* Stands before the C library of a program, and writes down what it syncs and what it names. */
#define _GNU_SOURCE
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/syscall.h>
#include <unistd.h>

static void say(const char *what, const char *from, const char *to) {
    const char *path = getenv("PLIANT_WITNESS");
    if (!path) return;
    long log = syscall(SYS_openat, AT_FDCWD, path, O_WRONLY | O_CREAT | O_APPEND, 0600);
    if (log < 0) return;
    char line[8192];
    int length = snprintf(line, sizeof line, "%s\t%s\t%s\n", what, from, to);
    if (length > 0 && length < (int)sizeof line) syscall(SYS_write, log, line, (size_t)length);
    syscall(SYS_close, log);
}

static int sync_of(long call, int fd) {
    char link[64], name[4096];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t length = readlink(link, name, sizeof name - 1);
    int result = (int)syscall(call, fd);
    if (result == 0 && length > 0) {
        name[length] = 0;
        say("sync", name, "");
    }
    return result;
}

int fsync(int fd) { return sync_of(SYS_fsync, fd); }
int fdatasync(int fd) { return sync_of(SYS_fdatasync, fd); }

static int named(int result, const char *from, const char *to) {
    if (result == 0) say("name", from, to);
    return result;
}

int rename(const char *from, const char *to) {
    return named((int)syscall(SYS_renameat2, AT_FDCWD, from, AT_FDCWD, to, 0), from, to);
}

int link(const char *from, const char *to) {
    return named((int)syscall(SYS_linkat, AT_FDCWD, from, AT_FDCWD, to, 0), from, to);
}

int linkat(int at, const char *from, int into, const char *to, int flags) {
    return named((int)syscall(SYS_linkat, at, from, into, to, flags), from, to);
}
