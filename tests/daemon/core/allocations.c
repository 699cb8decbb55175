/* Counts what one thread takes from Python's allocators: every object, whether it is kept or gone at once.
 *
 * Objects on the interpreter's free lists (floats, small tuples) are made without an allocator: empty the lists first
 * (gc.collect), then the first of each kind is counted. */

#include <Python.h>
#include <pthread.h>

static const PyMemAllocatorDomain DOMAINS[] = {PYMEM_DOMAIN_RAW, PYMEM_DOMAIN_MEM, PYMEM_DOMAIN_OBJ};
enum { COUNT = sizeof(DOMAINS) / sizeof(DOMAINS[0]) };
static PyMemAllocatorEx before[COUNT];
static pthread_t counted;
static long taken;

static void count(void)
{
    if (pthread_equal(pthread_self(), counted))
        taken += 1;
}

static void *take(void *ctx, size_t size)
{
    PyMemAllocatorEx *own = ctx;
    count();
    return own->malloc(own->ctx, size);
}

static void *take_zeroed(void *ctx, size_t number, size_t size)
{
    PyMemAllocatorEx *own = ctx;
    count();
    return own->calloc(own->ctx, number, size);
}

static void *take_more(void *ctx, void *old, size_t size)
{
    PyMemAllocatorEx *own = ctx;
    count();
    return own->realloc(own->ctx, old, size);
}

static void give_back(void *ctx, void *old)
{
    PyMemAllocatorEx *own = ctx;
    own->free(own->ctx, old);
}

/* Begin to count those of the calling thread. */
void begin(void)
{
    counted = pthread_self();
    for (int n = 0; n < COUNT; n++) {
        PyMemAllocatorEx hook = {&before[n], take, take_zeroed, take_more, give_back};
        PyMem_GetAllocator(DOMAINS[n], &before[n]);
        PyMem_SetAllocator(DOMAINS[n], &hook);
    }
    taken = 0;
}

/* End it; return how many there were. */
long end(void)
{
    long found = taken;
    for (int n = 0; n < COUNT; n++)
        PyMem_SetAllocator(DOMAINS[n], &before[n]);
    return found;
}
