/* Lets a library find the files of a package that was unpacked instead of installed.
 *
 * Loaded with LD_PRELOAD. A path under /usr that does not exist is looked for under the folder
 * named by UNPACKED as well: Mesa has the places of its OpenCL library compiled in.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

/* The path to use; `space` holds it where it is another than was asked for. */
static const char *found(const char *path, char *space, size_t size)
{
    const char *root = getenv("UNPACKED");
    if (root && path && strncmp(path, "/usr/", 5) == 0 && faccessat(AT_FDCWD, path, F_OK, 0) != 0
        && (size_t)snprintf(space, size, "%s%s", root, path) < size
        && faccessat(AT_FDCWD, space, F_OK, 0) == 0)
        return space;
    return path;
}

#define OPEN(name) \
    int name(const char *path, int flags, ...) \
    { \
        char space[4096]; \
        va_list rest; \
        va_start(rest, flags); \
        const mode_t mode = va_arg(rest, mode_t); \
        va_end(rest); \
        int (*next)(const char *, int, ...) = dlsym(RTLD_NEXT, #name); \
        return next(found(path, space, sizeof space), flags, mode); \
    }
OPEN(open)
OPEN(open64)

#define STAT(name, type) \
    int name(const char *path, struct type *buffer) \
    { \
        char space[4096]; \
        int (*next)(const char *, struct type *) = dlsym(RTLD_NEXT, #name); \
        return next(found(path, space, sizeof space), buffer); \
    }
STAT(stat, stat)
STAT(stat64, stat64)

FILE *fopen(const char *path, const char *mode)
{
    char space[4096];
    FILE *(*next)(const char *, const char *) = dlsym(RTLD_NEXT, "fopen");
    return next(found(path, space, sizeof space), mode);
}
