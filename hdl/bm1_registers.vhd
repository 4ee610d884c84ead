-- ================================================================================================
-- rosbayes: bm1_registers
-- Checks, executes and answers each access to the registers of a board, and starts the machine.
-- MIT licence; datasheet: docs/hardware/bm1_registers.md
-- ================================================================================================

library ieee;
  use ieee.std_logic_1164.all;
  use ieee.numeric_std.all;

library work;
  use work.bm1_parameters.all;
  use work.bm1_utilities.all;
  use work.bm_register_map.all;

entity bm1_registers is
  generic (
    LINES             : positive;                       -- number of lines on this board
    SENSORS           : natural;                        -- number of sensor columns
    REPLICAS          : positive;                       -- number of replicas: machines that share the generators
    MODE              : sensor_mode_t;                  -- input of the cells in a sensor column
    ADDRESS_BITS      : natural_array_t;                -- address widths of the sensor columns (index 1 to SENSORS)
    PROB_BITS         : positive;                       -- width of a probability code
    PRIOR_BITS        : natural;                        -- width of the prior's address
    WRITTEN           : boolean;                        -- true: the host writes the prior; false: the prior is a table
    COUNTER_BITS      : positive;                       -- width of a counter
    KIND              : rng_kind_t;                     -- generators: LFSR or table
    RNG_SHARED        : boolean;                        -- true: one generator per column; false: one per cell
    STEPS             : positive;                       -- steps of a generator per clock
    BANKS             : positive;                       -- number of seed sets (banks)
    RESET_BANK        : boolean;                        -- true: each frame restarts the generators; false: they continue
    INTERFACE_INPUTS  : positive;                       -- number of words of the block SENSORS or INPUTS
    INTERFACE_RESULTS : positive;                       -- number of words of the block RESULTS
    MODEL_LINES       : positive;                       -- number of lines of the whole model
    LINE_OFFSET       : natural;                        -- index of the first line of this board
    BOARD             : natural;                        -- index of this board
    BOARDS            : positive;                       -- number of boards
    IMAGE_HASH        : std_logic_vector(255 downto 0); -- identity of this board's image
    MEMORY_FOLDER     : string;                         -- folder of the MIFs, with a trailing slash
    CLOCK_HZ          : positive                        -- frequency of the clock in hertz
  );
  port (
    -- system
    clk_i : in    std_logic; -- clock
    rst_i : in    std_logic; -- reset of the board
    irq_o : out   std_logic; -- pulse: the machine has stopped
    -- access
    request_i : in    std_logic;                                       -- pulse: an access begins
    write_i   : in    std_logic;                                       -- 1: write, 0: read
    address_i : in    std_logic_vector(BAR_ADDRESS_BITS - 1 downto 0); -- address in bytes
    strobe_i  : in    std_logic_vector(3 downto 0);                    -- byte enables of a write
    data_i    : in    std_logic_vector(31 downto 0);                   -- data to write
    respond_o : out   std_logic;                                       -- pulse: the access is complete
    refused_o : out   std_logic;                                       -- the access was refused
    data_o    : out   std_logic_vector(31 downto 0);                   -- data that was read
    -- machine: commands and settings
    start_o       : out   std_logic;                                                   -- pulse: start a frame
    resume_o      : out   std_logic;                                                   -- pulse: run the frame's next slice
    reset_o       : out   std_logic;                                                   -- stop the machine and clear counters and cycles
    target_o      : out   std_logic_vector(COUNTER_BITS - 1 downto 0);                 -- target count
    max_cycles_o  : out   std_logic_vector(63 downto 0);                               -- maximum number of cycles of a frame
    run_until_o   : out   std_logic_vector(63 downto 0);                               -- cycle at which the slice ends
    bank_o        : out   std_logic_vector(bits_for(BANKS) - 1 downto 0);              -- index of the seed set
    halt_o        : out   std_logic_vector(REPLICAS - 1 downto 0);                     -- bit r: halt replica r
    priors_o      : out   std_logic_vector(REPLICAS * SLOT_BITS - 1 downto 0);         -- each replica's address in the prior's table
    prior_codes_o : out   std_logic_vector(REPLICAS * LINES * SLOT_BITS - 1 downto 0); -- codes of the written prior
    inputs_o      : out   std_logic_vector(
      REPLICAS * SENSORS * inputs_per_column(MODE, LINES) * SLOT_BITS - 1 downto 0);   -- readings
    -- machine: outcome
    running_i         : in    std_logic;                                                     -- the machine runs
    done_i            : in    std_logic;                                                     -- the machine stops in this clock
    has_run_i         : in    std_logic;                                                     -- the machine has run since the last reset
    cycles_i          : in    std_logic_vector(63 downto 0);                                 -- cycles of the frame
    reason_i          : in    std_logic_vector(2 downto 0);                                  -- stop reason
    ready_i           : in    std_logic_vector(REPLICAS - 1 downto 0);                       -- bit r: replica r can be resumed
    replica_reasons_i : in    std_logic_vector(3 * REPLICAS - 1 downto 0);                   -- stop reason of each replica
    replica_cycles_i  : in    std_logic_vector(64 * REPLICAS - 1 downto 0);                  -- cycles of each replica
    counts_i          : in    std_logic_vector(REPLICAS * LINES * COUNTER_BITS - 1 downto 0) -- counts of all lines
  );
end entity bm1_registers;

architecture rtl of bm1_registers is

  type state_t is (waiting, checking, reading);

  constant PLAIN         : boolean  := REPLICAS = 1 and MODE = SENSOR_COLUMN;
  constant SEVERAL       : natural  := REPLICAS * to_natural(REPLICAS > 1);
  constant RESULT_WORDS  : positive := REPLICAS * LINES;
  constant WRITTEN_WORDS : natural  := RESULT_WORDS * to_natural(WRITTEN);
  constant INPUT_WORDS   : natural  := REPLICAS * SENSORS * inputs_per_column(MODE, LINES);
  constant CLOCK_NS      : positive := (1_000_000_000 + CLOCK_HZ / 2) / CLOCK_HZ;

  -- Return a number as a register's word.

  function word (
    number : natural
  ) return std_logic_vector is
  begin

    return std_logic_vector(to_unsigned(number, 32));

  end function word;

  -- Return a SHA-256 as register words: its first byte in the lowest byte of word 0.

  function read_order (
    hash : std_logic_vector(255 downto 0)
  ) return std_logic_vector is

    variable turned : std_logic_vector(255 downto 0);

  begin

    for byte in 0 to 31 loop

      turned(8 * byte + 7 downto 8 * byte) := hash(255 - 8 * byte downto 248 - 8 * byte);

    end loop;

    return turned;

  end function read_order;

  -- Return the registers CAP_SENSOR_BITS: a byte for each column.

  function sensor_widths return std_logic_vector is

    variable bytes : std_logic_vector(511 downto 0) := (others => '0');

  begin

    for column in 1 to SENSORS loop

      if (column <= 64) then
        bytes(8 * column - 1 downto 8 * column - 8) := std_logic_vector(to_unsigned(ADDRESS_BITS(column), 8));
      end if;

    end loop;

    return bytes;

  end function sensor_widths;

  -- Return the register CAP_MACHINE.

  function machine return std_logic_vector is

    variable found : std_logic_vector(31 downto 0) := (others => '0');

  begin

    found(CAP_MACHINE_KIND_HIGH downto CAP_MACHINE_KIND_LOW) := std_logic_vector(to_unsigned(MACHINE_KIND_BM1, 8));
    -- the kinds of generators have the same order here and in the map, in which 0 is none
    found(CAP_MACHINE_RNG_HIGH downto CAP_MACHINE_RNG_LOW)                 := std_logic_vector(to_unsigned(rng_kind_t'pos(KIND) + 1, 8));
    found(CAP_MACHINE_SHARED_LOW)                                          := to_std_logic(RNG_SHARED);
    found(CAP_MACHINE_FREE_LOW)                                            := to_std_logic(not RESET_BANK);
    found(CAP_MACHINE_PRIOR_WRITTEN_LOW)                                   := to_std_logic(WRITTEN);
    found(CAP_MACHINE_SENSOR_MODE_HIGH downto CAP_MACHINE_SENSOR_MODE_LOW) := std_logic_vector(to_unsigned(sensor_mode_t'pos(MODE), 2));

    return found;

  end function machine;

  -- Return the widths of the input words, at least one.

  function input_widths return natural_array_t is
  begin

    if (SENSORS = 0) then
      return (1 to 1 => 1);
    end if;

    return ADDRESS_BITS;

  end function input_widths;

  signal state          : state_t                                         := waiting;
  signal write          : std_logic                                       := '0';
  signal address        : std_logic_vector(BAR_ADDRESS_BITS - 1 downto 0) := (others => '0');
  signal strobe         : std_logic_vector(3 downto 0)                    := (others => '0');
  signal data           : std_logic_vector(31 downto 0)                   := (others => '0');
  signal error_code     : std_logic_vector(7 downto 0)                    := (others => '0');
  signal done_number    : std_logic_vector(31 downto 0)                   := (others => '0');
  signal number         : std_logic_vector(31 downto 0)                   := (others => '0');
  signal compute_ns     : unsigned(63 downto 0)                           := (others => '0');
  signal verdict        : std_logic_vector(7 downto 0);
  signal rings          : std_logic;
  signal allowed        : std_logic;
  signal write_allowed  : std_logic;
  signal ring           : std_logic;
  signal is_register    : std_logic;
  signal is_inputs      : std_logic;
  signal is_selects     : std_logic;
  signal is_codes       : std_logic;
  signal is_outcomes    : std_logic;
  signal is_results     : std_logic;
  signal can_resume     : std_logic;
  signal bad_input      : std_logic;
  signal bad_inputs     : std_logic;
  signal bad_selects    : std_logic;
  signal bad_codes      : std_logic;
  signal busy           : std_logic;
  signal busy_inputs    : std_logic;
  signal busy_selects   : std_logic;
  signal busy_codes     : std_logic;
  signal register_write : std_logic;
  signal register_read  : std_logic;
  signal inputs_write   : std_logic;
  signal selects_write  : std_logic;
  signal codes_write    : std_logic;
  signal register_data  : std_logic_vector(31 downto 0);
  signal inputs_data    : std_logic_vector(31 downto 0);
  signal selects_data   : std_logic_vector(31 downto 0);
  signal codes_data     : std_logic_vector(31 downto 0);
  signal result_data    : std_logic_vector(31 downto 0);
  signal outcome_data   : std_logic_vector(31 downto 0);
  signal liveness       : std_logic_vector(31 downto 0);
  signal not_liveness   : std_logic_vector(31 downto 0);
  signal status         : std_logic_vector(31 downto 0);
  signal control        : std_logic_vector(31 downto 0);
  signal target         : std_logic_vector(31 downto 0);
  signal max_cycles     : std_logic_vector(63 downto 0);
  signal bank           : std_logic_vector(31 downto 0);
  signal prior_select   : std_logic_vector(31 downto 0);
  signal run_until      : std_logic_vector(63 downto 0);
  signal halt           : std_logic_vector(255 downto 0);

begin

  -- Process one access at a time: accept, check and execute it, and answer a read one clock later.
  sequence_of_access : process (clk_i) is
  begin

    if rising_edge(clk_i) then
      if (rst_i = '1') then
        state      <= waiting;
        error_code <= (others => '0');
      else
        -- no case: GHDL's synthesis turns a case over an enumeration into latches
        if (state = waiting) then
          if (request_i = '1') then
            state   <= checking;
            write   <= write_i;
            address <= address_i;
            strobe  <= strobe_i;
            data    <= data_i;
          end if;
        elsif (state = checking) then
          if (busy = '0') then
            if (allowed = '1' and write = '0') then
              state <= reading;
            else
              state <= waiting;
            end if;
            if (allowed = '0') then
              error_code <= verdict;
            end if;
          end if;
        else
          state <= waiting;
        end if;

        if (control(CONTROL_RESET_LOW) = '1') then
          error_code <= (others => '0');
        end if;
      end if;
    end if;

  end process sequence_of_access;

  guard : entity work.bm1_guard
    generic map (
      replicas            => REPLICAS,
      counter_bits        => COUNTER_BITS,
      prior_bits          => PRIOR_BITS,
      banks               => BANKS,
      sensors_depth       => INTERFACE_INPUTS * to_natural(PLAIN),
      inputs_depth        => INTERFACE_INPUTS * to_natural(not PLAIN),
      prior_selects_depth => SEVERAL,
      outcomes_depth      => 4 * SEVERAL,
      results_depth       => INTERFACE_RESULTS,
      prior_codes_depth   => WRITTEN_WORDS
    )
    port map (
      write_i      => write,
      address_i    => address,
      strobe_i     => strobe,
      data_i       => data,
      running_i    => running_i,
      can_resume_i => can_resume,
      ready_i      => ready_i,
      done_i       => done_number,
      cycles_i     => cycles_i,
      target_i     => target,
      max_cycles_i => max_cycles,
      run_until_i  => run_until,
      bank_i       => bank,
      prior_i      => prior_select,
      halt_i       => halt,
      bad_input_i  => bad_input,
      error_o      => verdict,
      ring_o       => rings
    );

  can_resume <= '1' when unsigned(reason_i) = STOP_REASON_SLICE else
                '0';
  bad_input  <= bad_inputs or bad_selects or bad_codes;
  busy       <= busy_inputs or busy_selects or busy_codes;

  allowed       <= '1' when unsigned(verdict) = ERROR_CODE_NONE else
                   '0';
  write_allowed <= '1' when state = checking and busy = '0' and allowed = '1' and write = '1' else
                   '0';
  ring          <= write_allowed and rings;
  respond_o     <= '1' when state = reading or (state = checking and busy = '0' and (allowed = '0' or write = '1')) else
                   '0';
  refused_o     <= '1' when state = checking and allowed = '0' else
                   '0';

  -- Select the block. The guard has checked the address, so it needs no exact decoding.
  is_inputs   <= '1' when (PLAIN and unsigned(address(16 downto 8)) = SENSORS_ADDRESS / 256)
                          or (not PLAIN and address(16) = '1') else
                 '0';
  is_selects  <= '1' when unsigned(address(16 downto 10)) = PRIOR_SELECTS_ADDRESS / 1024 else
                 '0';
  is_outcomes <= '1' when unsigned(address(16 downto 12)) = OUTCOMES_ADDRESS / 4096 else
                 '0';
  is_results  <= '1' when unsigned(address(16 downto 14)) = RESULTS_ADDRESS / 16384 else
                 '0';
  is_codes    <= '1' when unsigned(address(16 downto 14)) = PRIOR_CODES_ADDRESS / 16384 else
                 '0';
  is_register <= '1' when unsigned(address(16 downto 9)) = 0 else
                 '0';

  -- a doorbell of 0 does nothing, and must not be read back
  register_write <= '1' when write_allowed = '1' and is_register = '1'
                             and (rings = '1'
                          or (unsigned(address) /= START_ADDRESS and unsigned(address) /= RESUME_ADDRESS)) else
                    '0';
  register_read  <= '1' when state = checking and busy = '0' and allowed = '1' and write = '0' and is_register = '1' else
                    '0';
  inputs_write   <= write_allowed and is_inputs;
  selects_write  <= write_allowed and is_selects;
  codes_write    <= write_allowed and is_codes;

  data_o <= inputs_data when is_inputs = '1' else
            selects_data when is_selects = '1' else
            outcome_data when is_outcomes = '1' else
            result_data when is_results = '1' else
            codes_data when is_codes = '1' else
            register_data;

  -- The number of a doorbell becomes DONE when the machine has stopped.
  number_frames : process (clk_i) is
  begin

    if rising_edge(clk_i) then
      if (rst_i = '1') then
        number      <= (others => '0');
        done_number <= (others => '0');
      else
        if (ring = '1') then
          number <= data;
        end if;
        if (done_i = '1') then
          done_number <= number;
        end if;
      end if;
    end if;

  end process number_frames;

  measure_time : process (clk_i) is
  begin

    if rising_edge(clk_i) then
      if (rst_i = '1' or ring = '1' or control(CONTROL_RESET_LOW) = '1') then
        compute_ns <= (others => '0');
      elsif (running_i = '1') then
        compute_ns <= compute_ns + CLOCK_NS;
      end if;
    end if;

  end process measure_time;

  not_liveness <= not liveness;

  join_status : process (all) is

    variable board_state : natural range 0 to 15;

  begin

    if (running_i = '1') then
      board_state := BOARD_STATE_RUNNING;
    elsif (has_run_i = '1') then
      board_state := BOARD_STATE_DONE;
    else
      board_state := BOARD_STATE_IDLE;
    end if;

    status                                                           <= (others => '0');
    status(STATUS_STATE_HIGH downto STATUS_STATE_LOW)                <= std_logic_vector(to_unsigned(board_state, 4));
    status(STATUS_STOP_REASON_LOW + 2 downto STATUS_STOP_REASON_LOW) <= reason_i;
    status(STATUS_ERROR_HIGH downto STATUS_ERROR_LOW)                <= error_code;

  end process join_status;

  registers : entity work.bm_register_block
    port map (
      clk_i             => clk_i,
      rst_i             => rst_i,
      write_i           => register_write,
      read_i            => register_read,
      word_i            => address(9 downto 2),
      data_i            => data,
      data_o            => register_data,
      liveness_i        => not_liveness,
      liveness_o        => liveness,
      programmed_i      => word(1),
      map_hash_i        => read_order(MAP_SHA256),
      image_hash_i      => read_order(IMAGE_HASH),
      cap_machine_i     => machine,
      cap_lines_i       => word(LINES),
      cap_total_lines_i => word(MODEL_LINES),
      cap_line_offset_i => word(LINE_OFFSET),
      cap_partition_i   => std_logic_vector(to_unsigned(BOARDS, 16)) & std_logic_vector(to_unsigned(BOARD, 16)),
      cap_sensors_i     => word(SENSORS),
      cap_widths_i      => word(PROB_BITS + 256 * COUNTER_BITS + 65536 * PRIOR_BITS),
      cap_banks_i       => word(BANKS),
      cap_replicas_i    => word(REPLICAS),
      cap_interface_i   => std_logic_vector(to_unsigned(INTERFACE_RESULTS, 16))
                           & std_logic_vector(to_unsigned(INTERFACE_INPUTS, 16)),
      cap_speed_i       => word(CLOCK_HZ),
      cap_steps_i       => word(STEPS),
      cap_link_i        => (others => '0'),
      cap_sensor_bits_i => sensor_widths,
      control_o         => control,
      target_count_o    => target,
      max_cycles_o      => max_cycles,
      bank_o            => bank,
      prior_select_o    => prior_select,
      run_until_o       => run_until,
      start_o           => open,
      resume_o          => open,
      done_i            => done_number,
      status_i          => status,
      cycles_i          => cycles_i,
      compute_ns_i      => std_logic_vector(compute_ns),
      halt_o            => halt
    );

  reading_words : entity work.bm1_words
    generic map (
      depth         => INTERFACE_INPUTS,
      used          => INPUT_WORDS,
      widths        => input_widths,
      per_column    => inputs_per_column(MODE, LINES),
      initial_file  => "",
      initial_words => 1,
      initial_bits  => 1
    )
    port map (
      clk_i    => clk_i,
      rst_i    => rst_i,
      busy_o   => busy_inputs,
      write_i  => inputs_write,
      index_i  => address(bits_for(INTERFACE_INPUTS) + 1 downto 2),
      data_i   => data,
      data_o   => inputs_data,
      values_o => inputs_o,
      bad_o    => bad_inputs
    );

  prior_selects : if REPLICAS > 1 generate

    select_words : entity work.bm1_words
      generic map (
        depth         => REPLICAS,
        used          => REPLICAS,
        widths        => (1 to 1 => PRIOR_BITS),
        per_column    => REPLICAS,
        initial_file  => "",
        initial_words => 1,
        initial_bits  => 1
      )
      port map (
        clk_i    => clk_i,
        rst_i    => rst_i,
        busy_o   => busy_selects,
        write_i  => selects_write,
        index_i  => address(bits_for(REPLICAS) + 1 downto 2),
        data_i   => data,
        data_o   => selects_data,
        values_o => priors_o,
        bad_o    => bad_selects
      );

  else generate
    busy_selects <= '0';
    bad_selects  <= '0';
    selects_data <= (others => '0');
    priors_o     <= prior_select(SLOT_BITS - 1 downto 0);
  end generate prior_selects;

  prior_codes : if WRITTEN generate

    code_words : entity work.bm1_words
      generic map (
        depth         => RESULT_WORDS,
        used          => RESULT_WORDS,
        widths        => (1 to 1 => PROB_BITS),
        per_column    => RESULT_WORDS,
        initial_file  => MEMORY_FOLDER & "board" & integer'image(BOARD) & "_prior.mif",
        initial_words => LINES,
        initial_bits  => PROB_BITS
      )
      port map (
        clk_i    => clk_i,
        rst_i    => rst_i,
        busy_o   => busy_codes,
        write_i  => codes_write,
        index_i  => address(bits_for(RESULT_WORDS) + 1 downto 2),
        data_i   => data,
        data_o   => codes_data,
        values_o => prior_codes_o,
        bad_o    => bad_codes
      );

  else generate
    busy_codes    <= '0';
    bad_codes     <= '0';
    codes_data    <= (others => '0');
    prior_codes_o <= (others => '0');
  end generate prior_codes;

  readout : entity work.bm1_readout
    generic map (
      results      => RESULT_WORDS,
      counter_bits => COUNTER_BITS,
      replicas     => REPLICAS
    )
    port map (
      clk_i     => clk_i,
      index_i   => address(13 downto 2),
      counts_i  => counts_i,
      reasons_i => replica_reasons_i,
      cycles_i  => replica_cycles_i,
      result_o  => result_data,
      outcome_o => outcome_data
    );

  start_o      <= '1' when ring = '1' and unsigned(address) = START_ADDRESS else
                  '0';
  resume_o     <= '1' when ring = '1' and unsigned(address) = RESUME_ADDRESS else
                  '0';
  reset_o      <= control(CONTROL_RESET_LOW);
  target_o     <= target(COUNTER_BITS - 1 downto 0);
  max_cycles_o <= max_cycles;
  run_until_o  <= run_until;
  bank_o       <= bank(bits_for(BANKS) - 1 downto 0);
  halt_o       <= halt(REPLICAS - 1 downto 0);
  irq_o        <= done_i and control(CONTROL_INTERRUPT_ENABLE_LOW);

end architecture rtl;
