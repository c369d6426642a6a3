/* Loaded before the C library (LD_PRELOAD): calls below one folder are counted, recorded, and one of them is refused.
 *
 * Python, zarr, pyarrow, safetensors and OpenImageIO all end here, so that no layer is left out and nothing of ours is
 * replaced by a double. Controlled from Python by `faults.py`, through the four functions at the end. Linux alone.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

#define FILES 4096
static char root[PATH_MAX];          /* the folder that is watched; empty: none */
static char *paths[FILES];           /* by descriptor: the path of a file below the root that is open, or NULL */
static long counted, refused_at;     /* calls since the last arming; the one to refuse, 0 for none */
static int refusal;                  /* the error it ends with */
static char refused[PATH_MAX + 32];  /* what was refused, such as "rename /tmp/a" */
static int record = -1;              /* descriptor of the record, or -1 */
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;

#define REAL(name) static __typeof__(name) *real; if (!real) real = dlsym(RTLD_NEXT, #name)

static const char *absolute(int folder, const char *path, char *out) {
    char base[PATH_MAX] = "", link[64];
    if (path[0] == '/') { snprintf(out, PATH_MAX, "%s", path); return out; }
    if (folder == AT_FDCWD) { if (!getcwd(base, sizeof base)) base[0] = 0; }
    else {
        snprintf(link, sizeof link, "/proc/self/fd/%d", folder);
        ssize_t n = readlink(link, base, sizeof base - 1);
        base[n > 0 ? n : 0] = 0;
    }
    snprintf(out, PATH_MAX, "%.2000s/%.2000s", base, path);
    return out;
}

static int watched(const char *path) {
    size_t n = strlen(root);
    return n && !strncmp(path, root, n) && (path[n] == '/' || !path[n]);
}

/* Counts a call; 1 if it is the one to be refused. */
static int refuse(const char *call, const char *path) {
    pthread_mutex_lock(&lock);
    int now = ++counted == refused_at;
    if (now) snprintf(refused, sizeof refused, "%s %s", call, path);
    pthread_mutex_unlock(&lock);
    if (now) errno = refusal;
    return now;
}

/* One event: kind, lengths of both paths and of the data, then these. Data follows its offset in the file. */
static void note(char kind, const char *path, const char *other, int64_t offset, const void *data, size_t size) {
    if (record < 0) return;
    REAL(write);
    int32_t head[2] = {(int32_t)strlen(path), other ? (int32_t)strlen(other) : 0};
    int64_t tail[2] = {offset, (int64_t)size};
    pthread_mutex_lock(&lock);
    ssize_t done = real(record, &kind, 1);
    done += real(record, head, sizeof head) + real(record, tail, sizeof tail) + real(record, path, head[0]);
    if (other) done += real(record, other, head[1]);
    if (size) done += real(record, data, size);
    pthread_mutex_unlock(&lock);
    if (done < 0) abort();
}

static void opened(int file, const char *path, int flags) {
    if (file < 0 || file >= FILES) return;
    free(paths[file]);
    paths[file] = strdup(path);
    if (flags & (O_CREAT | O_TRUNC)) note(flags & O_TRUNC ? 't' : 'c', path, NULL, 0, NULL, 0);
}

static int open_file(int folder, const char *path, int flags, mode_t mode) {
    char full[PATH_MAX];
    REAL(openat);
    int ours = watched(absolute(folder, path, full));
    if (ours && refuse(flags & (O_WRONLY | O_RDWR) ? "open-to-write" : "open", full)) return -1;
    int file = real(folder, path, flags, mode);
    if (file >= 0 && file < FILES) { free(paths[file]); paths[file] = NULL; }
    if (ours) { int error = errno; opened(file, full, flags); errno = error; }
    return file;
}

#define MODE(flags) mode_t mode = 0; \
    if ((flags) & (O_CREAT | O_TMPFILE)) { va_list more; va_start(more, flags); mode = va_arg(more, mode_t); va_end(more); }
int open(const char *path, int flags, ...) { MODE(flags) return open_file(AT_FDCWD, path, flags, mode); }
int open64(const char *path, int flags, ...) { MODE(flags) return open_file(AT_FDCWD, path, flags | O_LARGEFILE, mode); }
int openat(int folder, const char *path, int flags, ...) { MODE(flags) return open_file(folder, path, flags, mode); }
int openat64(int folder, const char *path, int flags, ...) { MODE(flags) return open_file(folder, path, flags, mode); }
int creat(const char *path, mode_t mode) { return open_file(AT_FDCWD, path, O_CREAT | O_WRONLY | O_TRUNC, mode); }

int close(int file) {
    REAL(close);
    if (file >= 0 && file < FILES && paths[file]) { free(paths[file]); paths[file] = NULL; }
    return real(file);
}

static const char *path_of(int file) { return file >= 0 && file < FILES ? paths[file] : NULL; }

ssize_t write(int file, const void *data, size_t size) {
    REAL(write);
    const char *path = path_of(file);
    if (!path) return real(file, data, size);
    if (refuse("write", path)) return -1;
    off_t offset = lseek(file, 0, SEEK_CUR);
    ssize_t done = real(file, data, size);
    if (done > 0) note('w', path, NULL, offset, data, (size_t)done);
    return done;
}

ssize_t pwrite64(int file, const void *data, size_t size, off64_t offset) {
    REAL(pwrite64);
    const char *path = path_of(file);
    if (path && refuse("write", path)) return -1;
    ssize_t done = real(file, data, size, offset);
    if (path && done > 0) note('w', path, NULL, offset, data, (size_t)done);
    return done;
}

ssize_t pwrite(int file, const void *data, size_t size, off_t offset) { return pwrite64(file, data, size, offset); }

ssize_t writev(int file, const struct iovec *parts, int count) {
    REAL(writev);
    if (!path_of(file)) return real(file, parts, count);
    ssize_t total = 0;
    for (int i = 0; i < count; i++) {
        ssize_t done = write(file, parts[i].iov_base, parts[i].iov_len);
        if (done < 0) return total ? total : -1;
        total += done;
        if ((size_t)done < parts[i].iov_len) break;
    }
    return total;
}

/* Streams of C: their own writes never leave the C library, so one is refused and recorded where it is asked for. */
FILE *fopen(const char *path, const char *mode) {
    REAL(fopen);
    char full[PATH_MAX];
    int ours = watched(absolute(AT_FDCWD, path, full));
    if (ours && refuse(mode[0] == 'r' && !strchr(mode, '+') ? "open" : "open-to-write", full)) return NULL;
    FILE *file = real(path, mode);
    if (ours && file && mode[0] != 'r') opened(fileno(file), full, mode[0] == 'w' ? O_CREAT | O_TRUNC : O_CREAT);
    return file;
}
FILE *fopen64(const char *path, const char *mode) { return fopen(path, mode); }

size_t fwrite(const void *data, size_t size, size_t count, FILE *file) {
    REAL(fwrite);
    const char *path = path_of(fileno(file));
    if (path && refuse("write", path)) return 0;
    off_t offset = path ? ftello(file) : 0;
    size_t done = real(data, size, count, file);
    if (path && done) note('w', path, NULL, offset, data, done * size);
    return done;
}

int fclose(FILE *file) {
    REAL(fclose);
    int number = fileno(file);
    if (number >= 0 && number < FILES && paths[number]) { free(paths[number]); paths[number] = NULL; }
    return real(file);
}

int fsync(int file) {
    REAL(fsync);
    const char *path = path_of(file);
    if (path && refuse("fsync", path)) return -1;
    int done = real(file);
    if (path && !done) note('s', path, NULL, 0, NULL, 0);
    return done;
}
int fdatasync(int file) { return fsync(file); }

int ftruncate64(int file, off64_t size) {
    REAL(ftruncate64);
    const char *path = path_of(file);
    int done = real(file, size);
    if (path && !done) note('l', path, NULL, size, NULL, 0);
    return done;
}
int ftruncate(int file, off_t size) { return ftruncate64(file, size); }

int renameat(int from_folder, const char *from, int to_folder, const char *to) {
    REAL(renameat);
    char a[PATH_MAX], b[PATH_MAX];
    absolute(from_folder, from, a), absolute(to_folder, to, b);
    int ours = watched(a) || watched(b);
    if (ours && refuse("rename", a)) return -1;
    int done = real(from_folder, from, to_folder, to);
    if (ours && !done) note('r', a, b, 0, NULL, 0);
    return done;
}
int rename(const char *from, const char *to) { return renameat(AT_FDCWD, from, AT_FDCWD, to); }

int mkdirat(int folder, const char *path, mode_t mode) {
    REAL(mkdirat);
    char full[PATH_MAX];
    int ours = watched(absolute(folder, path, full));
    if (ours && refuse("mkdir", full)) return -1;
    int done = real(folder, path, mode);
    if (ours && !done) note('m', full, NULL, 0, NULL, 0);
    return done;
}
int mkdir(const char *path, mode_t mode) { return mkdirat(AT_FDCWD, path, mode); }

/* Removals are recorded and never refused: clean-up after a refusal is the subject of the test. */
int unlinkat(int folder, const char *path, int flags) {
    REAL(unlinkat);
    char full[PATH_MAX];
    int ours = watched(absolute(folder, path, full));
    int done = real(folder, path, flags);
    if (ours && !done) note('u', full, NULL, 0, NULL, 0);
    return done;
}
int unlink(const char *path) { return unlinkat(AT_FDCWD, path, 0); }
int remove(const char *path) { int done = unlinkat(AT_FDCWD, path, 0); return done ? rmdir(path) : done; }
int rmdir(const char *path) { return unlinkat(AT_FDCWD, path, AT_REMOVEDIR); }

void faults_watch(const char *folder) { snprintf(root, sizeof root, "%s", folder); counted = 0, refused_at = 0; }
void faults_arm(long call, int error) { counted = 0, refused_at = call, refusal = error, refused[0] = 0; }
long faults_counted(void) { return counted; }
const char *faults_refused(void) { return refused; }
void faults_record(int file) { record = file; }
