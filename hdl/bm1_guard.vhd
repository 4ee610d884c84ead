-- ================================================================================================
-- rosbayes: bm1_guard
-- Accepts or refuses each access by its address, its value and the state of the board.
-- MIT licence; datasheet: docs/hardware/bm1_guard.md
-- ================================================================================================

library ieee;
  use ieee.std_logic_1164.all;
  use ieee.numeric_std.all;

library work;
  use work.bm_register_map.all;

entity bm1_guard is
  generic (
    REPLICAS            : positive; -- number of replicas: machines that share the generators
    COUNTER_BITS        : positive; -- width of a counter
    PRIOR_BITS          : natural;  -- width of the prior select
    BANKS               : positive; -- number of seed sets
    SENSORS_DEPTH       : natural;  -- number of implemented words of SENSORS
    INPUTS_DEPTH        : natural;  -- number of implemented words of INPUTS
    PRIOR_SELECTS_DEPTH : natural;  -- number of implemented words of PRIOR_SELECTS
    OUTCOMES_DEPTH      : natural;  -- number of implemented words of OUTCOMES
    RESULTS_DEPTH       : natural;  -- number of implemented words of RESULTS
    PRIOR_CODES_DEPTH   : natural   -- number of implemented words of PRIOR_CODES
  );
  port (
    -- access
    write_i   : in    std_logic;                                       -- 1: write, 0: read
    address_i : in    std_logic_vector(BAR_ADDRESS_BITS - 1 downto 0); -- address in bytes
    strobe_i  : in    std_logic_vector(3 downto 0);                    -- byte enables of a write
    data_i    : in    std_logic_vector(31 downto 0);                   -- data to write
    -- state
    running_i    : in    std_logic;                               -- the machine runs
    can_resume_i : in    std_logic;                               -- the machine is at the end of a slice
    ready_i      : in    std_logic_vector(REPLICAS - 1 downto 0); -- bit r: replica r can be resumed
    done_i       : in    std_logic_vector(31 downto 0);           -- register DONE: doorbell number of the last start or resume that ended
    cycles_i     : in    std_logic_vector(63 downto 0);           -- number of cycles of the frame so far
    -- settings
    target_i     : in    std_logic_vector(31 downto 0);  -- target count
    max_cycles_i : in    std_logic_vector(63 downto 0);  -- maximum cycles
    run_until_i  : in    std_logic_vector(63 downto 0);  -- cycle at which the slice ends; 0: no end
    bank_i       : in    std_logic_vector(31 downto 0);  -- number of the seed set
    prior_i      : in    std_logic_vector(31 downto 0);  -- prior select of a board without replicas
    halt_i       : in    std_logic_vector(255 downto 0); -- bit r of HALT: replica r does not continue at a resume
    bad_input_i  : in    std_logic;                      -- an input word is too large
    -- verdict
    error_o : out   std_logic_vector(7 downto 0); -- reason of a refusal; 0: none
    ring_o  : out   std_logic                     -- the access is a valid doorbell
  );
end entity bm1_guard;

architecture rtl of bm1_guard is

  type access_t is (absent, readable, writable);

  -- Return whether an address is in the first words of a block.

  function is_in (
    address : unsigned;
    first   : natural;
    words   : natural
  ) return boolean is
  begin

    return address >= first and address < first + 4 * words;

  end function is_in;

  signal kind           : access_t;
  signal due            : unsigned(31 downto 0);
  signal doorbell_error : natural range 0 to 255;
  signal start_is_bad   : std_logic;
  signal resume_is_bad  : std_logic;
  signal is_start       : std_logic;
  signal is_resume      : std_logic;

begin

  find_block : process (all) is

    variable address : unsigned(BAR_ADDRESS_BITS - 1 downto 0);

  begin

    address := unsigned(address_i);
    kind    <= absent;

    for block_number in BLOCKS'range loop

      if (not BLOCKS(block_number).memory
          and is_in(address, BLOCKS(block_number).address, BLOCKS(block_number).words)) then
        if (BLOCKS(block_number).writable) then
          kind <= writable;
        else
          kind <= readable;
        end if;
      end if;

    end loop;

    if (is_in(address, SENSORS_ADDRESS, SENSORS_DEPTH)
        or is_in(address, INPUTS_ADDRESS, INPUTS_DEPTH)
        or is_in(address, PRIOR_SELECTS_ADDRESS, PRIOR_SELECTS_DEPTH)
        or is_in(address, PRIOR_CODES_ADDRESS, PRIOR_CODES_DEPTH)) then
      kind <= writable;
    end if;

    if (is_in(address, OUTCOMES_ADDRESS, OUTCOMES_DEPTH) or is_in(address, RESULTS_ADDRESS, RESULTS_DEPTH)) then
      kind <= readable;
    end if;

  end process find_block;

  is_start  <= '1' when write_i = '1' and unsigned(address_i) = START_ADDRESS and unsigned(data_i) /= 0 else
               '0';
  is_resume <= '1' when write_i = '1' and unsigned(address_i) = RESUME_ADDRESS and unsigned(data_i) /= 0 else
               '0';

  -- doorbell numbers wrap from 2^32 - 1 to 1
  due <= to_unsigned(1, 32) when (and done_i) = '1' else
         unsigned(done_i) + 1;

  check_start : process (all) is
  begin

    start_is_bad <= bad_input_i or max_cycles_i(63);

    if (unsigned(target_i) = 0 or unsigned(max_cycles_i) = 0 or unsigned(bank_i) >= BANKS) then
      start_is_bad <= '1';
    end if;

    for bit_number in COUNTER_BITS to 31 loop

      if (target_i(bit_number) = '1') then
        start_is_bad <= '1';
      end if;

    end loop;

    if (REPLICAS = 1 and (or prior_i(31 downto PRIOR_BITS)) = '1') then
      start_is_bad <= '1';
    end if;

  end process check_start;

  check_resume : process (all) is
  begin

    resume_is_bad <= '0';

    if (unsigned(run_until_i) /= 0 and unsigned(run_until_i) <= unsigned(cycles_i)) then
      resume_is_bad <= '1';
    end if;

    if (REPLICAS > 1) then
      if ((or (ready_i and not halt_i(REPLICAS - 1 downto 0))) = '0') then
        resume_is_bad <= '1';
      end if;

      if (REPLICAS < 256 and (or halt_i(255 downto REPLICAS)) = '1') then
        resume_is_bad <= '1';
      end if;
    end if;

  end process check_resume;

  check_doorbell : process (all) is
  begin

    doorbell_error <= ERROR_CODE_NONE;

    if (unsigned(data_i) /= due) then
      doorbell_error <= ERROR_CODE_DOORBELL;
    elsif (run_until_i(63) = '1') then
      doorbell_error <= ERROR_CODE_BAD_VALUE;
    elsif (is_resume = '1' and can_resume_i = '0') then
      doorbell_error <= ERROR_CODE_DOORBELL;
    elsif ((is_resume = '1' and resume_is_bad = '1') or (is_start = '1' and start_is_bad = '1')) then
      doorbell_error <= ERROR_CODE_BAD_VALUE;
    end if;

  end process check_doorbell;

  judge : process (all) is

    variable code : natural range 0 to 255;

  begin

    code := ERROR_CODE_NONE;

    if (address_i(1 downto 0) /= "00" or (write_i = '1' and strobe_i /= "1111")) then
      code := ERROR_CODE_MISALIGNED;
    elsif (kind = absent) then
      code := ERROR_CODE_OUTSIDE;
    elsif (write_i = '1') then
      if (kind /= writable) then
        code := ERROR_CODE_READ_ONLY;
      elsif (running_i = '1'
             and not (unsigned(address_i) = CONTROL_ADDRESS and data_i(CONTROL_RESET_LOW) = '1')) then
        code := ERROR_CODE_BUSY;
      elsif (is_start = '1' or is_resume = '1') then
        code := doorbell_error;
      end if;
    end if;

    error_o <= std_logic_vector(to_unsigned(code, 8));
    ring_o  <= '0';

    if (code = ERROR_CODE_NONE) then
      ring_o <= is_start or is_resume;
    end if;

  end process judge;

end architecture rtl;
