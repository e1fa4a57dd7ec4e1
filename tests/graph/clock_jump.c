/* For a process that has it preloaded, the host's clock is set by as many seconds as the file $CLOCK_OFFSET says, whenever it says so.

   Whoever waits for a moment of that clock waits longer when it is set back and is woken when it is set forward, as in the kernel.
   Clocks that cannot be set, and waits by them, are as ever. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <semaphore.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

#define NS 1000000000L
#define GLANCE (NS / 2)   /* between looks at whether the clock was set while somebody waits by it */
#define SINCE_BOOT 1000000000L /* seconds; an earlier deadline is one of the steady clock, by which a condition may be told to wait */

static const volatile int64_t nothing, *offset = &nothing;

__attribute__((constructor)) static void begin(void) {
    const char *path = getenv("CLOCK_OFFSET");
    int file = path ? open(path, O_RDONLY | O_CLOEXEC) : -1;
    void *shared = file < 0 ? MAP_FAILED : mmap(NULL, sizeof *offset, PROT_READ, MAP_SHARED, file, 0);
    if (shared == MAP_FAILED)
        abort();
    close(file);
    offset = shared;
}

#define REAL(name) ({ static __typeof__(&name) real; if (!real) real = (__typeof__(&name))dlsym(RTLD_NEXT, #name); real; })

static int can_be_set(clockid_t clock) { return clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE; }

int clock_gettime(clockid_t clock, struct timespec *now) {
    int failed = REAL(clock_gettime)(clock, now);
    if (!failed && can_be_set(clock))
        now->tv_sec += *offset;
    return failed;
}

int gettimeofday(struct timeval *restrict now, void *restrict zone) {
    int failed = REAL(gettimeofday)(now, zone);
    if (!failed)
        now->tv_sec += *offset;
    return failed;
}

time_t time(time_t *out) {
    time_t now = REAL(time)(NULL) + *offset;
    if (out)
        *out = now;
    return now;
}

/* The kernel's time at which to look again: the deadline, or sooner. */
static struct timespec next_look(const struct timespec *deadline) {
    struct timespec now;
    REAL(clock_gettime)(CLOCK_REALTIME, &now);
    long left = deadline->tv_sec - *offset - now.tv_sec;
    long wait = left < -1 ? 0 : left > 1 ? GLANCE : left * NS + deadline->tv_nsec - now.tv_nsec;
    wait = wait < 0 ? 0 : wait > GLANCE ? GLANCE : wait;
    now.tv_sec += (now.tv_nsec + wait) / NS;
    now.tv_nsec = (now.tv_nsec + wait) % NS;
    return now;
}

static int is_over(const struct timespec *deadline) {
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    return now.tv_sec > deadline->tv_sec || (now.tv_sec == deadline->tv_sec && now.tv_nsec >= deadline->tv_nsec);
}

#define WAIT(timed_out, call)                                  \
    for (;;) {                                                 \
        struct timespec look = next_look(deadline);            \
        int result = call;                                     \
        if (!(timed_out) || is_over(deadline))                 \
            return result;                                     \
    }

int pthread_cond_timedwait(pthread_cond_t *restrict condition, pthread_mutex_t *restrict mutex, const struct timespec *restrict deadline) {
    if (deadline->tv_sec < SINCE_BOOT)
        return REAL(pthread_cond_timedwait)(condition, mutex, deadline);
    WAIT(result == ETIMEDOUT, REAL(pthread_cond_timedwait)(condition, mutex, &look))
}

int pthread_mutex_timedlock(pthread_mutex_t *restrict mutex, const struct timespec *restrict deadline) {
    WAIT(result == ETIMEDOUT, REAL(pthread_mutex_timedlock)(mutex, &look))
}

int sem_timedwait(sem_t *restrict semaphore, const struct timespec *restrict deadline) {
    WAIT(result && errno == ETIMEDOUT, REAL(sem_timedwait)(semaphore, &look))
}
