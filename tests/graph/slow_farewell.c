/* For a process that has it preloaded, it takes a while to be told of a publisher or subscription that is gone, and a little before
   it listens to no more of that: it is then being told. The file $TOLD is made with the first. A breath before each message lets it
   get so far while there is more to be told. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdbool.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <unistd.h>

#define A_WHILE 50000 /* us */
#define A_LITTLE (A_WHILE / 2)
#define A_BREATH (A_WHILE / 10)

#define GRAPH_CACHE_REMOVE_ENTITY "_ZN14rmw_dds_common10GraphCache13remove_entityERK9rmw_gid_sb"
#define PARTICIPANT_SET_LISTENER "_ZN8eprosima7fastdds3dds17DomainParticipant12set_listenerEPNS1_25DomainParticipantListenerE" \
    "NSt6chrono8durationIlSt5ratioILl1ELl1EEEE"

bool remove_entity(void *graph, const void *gid, bool is_reader) __asm__(GRAPH_CACHE_REMOVE_ENTITY);
unsigned set_listener(void *participant, void *listener, long patience) __asm__(PARTICIPANT_SET_LISTENER);

/* The libraries were loaded for rclpy alone: RTLD_NEXT does not find them. */
static void *find(const char *library, const char *name) { return dlsym(dlopen(library, RTLD_NOLOAD | RTLD_LAZY), name); }

bool remove_entity(void *graph, const void *gid, bool is_reader) {
    close(open(getenv("TOLD"), O_CREAT | O_WRONLY, 0600));
    usleep(A_WHILE);
    static __typeof__(&remove_entity) real;
    if (!real)
        real = find("librmw_dds_common.so", GRAPH_CACHE_REMOVE_ENTITY);
    return real(graph, gid, is_reader);
}

unsigned set_listener(void *participant, void *listener, long patience) {
    usleep(A_LITTLE);
    static __typeof__(&set_listener) real;
    if (!real)
        real = find("librmw_fastrtps_cpp.so", PARTICIPANT_SET_LISTENER);
    return real(participant, listener, patience);
}

ssize_t recvfrom(int socket, void *restrict buffer, size_t length, int flags, struct sockaddr *restrict from,
                 socklen_t *restrict size) {
    static __typeof__(&recvfrom) real;
    if (!real)
        real = (__typeof__(&recvfrom))dlsym(RTLD_NEXT, "recvfrom");
    usleep(A_BREATH);
    return real(socket, buffer, length, flags, from, size);
}
