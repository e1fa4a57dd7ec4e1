/* For a process that has it preloaded, the first message of a subscription comes at the worst moment: after rmw has counted that
   there is none, and before it listens. That it has counted is told by the file $COUNTED. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <link.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#define DATA_READER_GET_UNREAD_COUNT "_ZNK8eprosima7fastdds3dds10DataReader16get_unread_countEb"
#define GLANCE 1000 /* us */
#define PATIENCE 60000000 /* us */

uint64_t unread(const void *reader, _Bool mark_as_read) __asm__(DATA_READER_GET_UNREAD_COUNT);

/* Fast DDS was loaded for rmw alone: RTLD_NEXT does not find it. */
static int find(struct dl_phdr_info *info, size_t size, void *found) {
    if (!strstr(info->dlpi_name, "libfastrtps.so"))
        return 0;
    *(void **)found = dlsym(dlopen(info->dlpi_name, RTLD_NOLOAD | RTLD_LAZY), DATA_READER_GET_UNREAD_COUNT);
    return 1;
}

/* Services are counted as well. */
static int is_of_subscription(const void *caller) {
    Dl_info code;
    return dladdr(caller, &code) && code.dli_sname && strstr(code.dli_sname, "RMWSubscriptionEvent");
}

uint64_t unread(const void *reader, _Bool mark_as_read) {
    static __typeof__(&unread) real;
    if (!real && !dl_iterate_phdr(find, &real))
        abort();
    uint64_t count = real(reader, mark_as_read);
    if (!count && is_of_subscription(__builtin_return_address(0))) {
        close(open(getenv("COUNTED"), O_WRONLY | O_CREAT, 0600));
        for (int waited = 0; waited < PATIENCE && !real(reader, 0); waited += GLANCE)
            usleep(GLANCE);
    }
    return count;
}
